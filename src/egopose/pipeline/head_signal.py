"""From motion capture of many people to a regressor of head signals, trained, judged and saved."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egopose.checkpoint.head_signal import save_head_signal_regressor
from egopose.core.config import from_mapping
from egopose.data.preparation import humanoid_of
from egopose.motion.rotations import Array
from egopose.pipeline.mocap_sources import clips_of, folder_to_make
from egopose.training.head_signal_figures import held_out_figures
from egopose.training.head_signal_regressor import HeadSignalSettings, train_head_signal_regressor

_SOURCE = "conf/head_signal.yaml"


def motions_of(values: Mapping[str, Any]) -> tuple[list[Array], list[Array]]:
    """Motions ``qpos [T, nq]`` to learn from and to be judged on, of the sources in ``conf/head_signal.yaml``.

    See :func:`egopose.pipeline.mocap_sources.clips_of`.

    Raises:
        InputError: a source cannot be used, none is given, or ``whole`` names none of them.
    """
    train, test = clips_of(values, _SOURCE)
    return [clip.qpos for clip in train], [clip.qpos for clip in test]


def make_head_signal_regressor(values: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Run ``conf/head_signal.yaml``, resolved; returns the figures by mount, empty where nothing is held out.

    Raises:
        InputError: a source or a setting cannot be used, or ``out`` is there.
    """
    out = folder_to_make(values)
    settings = from_mapping(HeadSignalSettings, values["training"], f"{_SOURCE}: training")
    humanoid = humanoid_of(values)
    train, test = motions_of(values)
    print(f"{len(train)} clips to learn from, {sum(map(len, train))} frames", file=sys.stderr, flush=True)

    def tell(epoch: int, error: float, seconds: float) -> None:
        print(f"epoch {epoch} of {settings.epochs}, error {error:.4f}, {seconds:.1f} s", file=sys.stderr, flush=True)

    model = train_head_signal_regressor(humanoid, train, settings, tell)
    save_head_signal_regressor(model, humanoid, settings, out)
    if not test:
        return {}
    pitch = 0.5 * sum(settings.pitch_down)
    return held_out_figures(model, humanoid, test, tuple(settings.mounts), pitch)


def train_head_signal(values: Mapping[str, Any]) -> None:
    """:func:`make_head_signal_regressor`, and what it found on the terminal.

    Raises:
        InputError: see there.
    """
    figures = make_head_signal_regressor(values)
    print("held-out people, exact signals:" if figures else "no source holds people out: nothing is judged")
    for mount, row in figures.items():
        print(f"{mount}: " + ", ".join(f"{name} {value:.3f}" for name, value in row.items()))
    print(f"regressor: {Path(str(values['out']))}")
