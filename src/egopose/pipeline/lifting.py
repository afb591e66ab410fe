"""From motion capture of many people to a network that lifts 2D keypoints, trained, judged and saved."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from egopose.checkpoint.lifting import save_lifting_network
from egopose.core.config import from_mapping
from egopose.data.preparation import humanoid_of
from egopose.pipeline.mocap_sources import clips_of, folder_to_make
from egopose.training.lifting_data import SightSettings
from egopose.training.lifting_network import LifterSettings, lifting_errors, train_lifting_network

_SOURCE = "conf/lifter.yaml"
_CAMERAS = 100  # seed of the cameras it is judged through: the same for every network


def train_lifter(values: Mapping[str, Any]) -> None:
    """Run ``conf/lifter.yaml``, resolved; the figures go to the terminal and to ``out/result.json``.

    Raises:
        InputError: a source or a setting cannot be used, or ``out`` is there.
    """
    out = folder_to_make(values)
    sight = from_mapping(SightSettings, values["sight"], f"{_SOURCE}: sight")
    settings = from_mapping(LifterSettings, values["training"], f"{_SOURCE}: training")
    humanoid = humanoid_of(values)
    train, test = clips_of(values, _SOURCE)
    print(f"{len(train)} clips, {sum(len(clip) for clip in train)} frames", file=sys.stderr, flush=True)

    def tell(epoch: int, loss: float, seconds: float) -> None:
        print(f"epoch {epoch} of {settings.epochs}, {loss:.4f} heights, {seconds:.1f} s", file=sys.stderr, flush=True)

    network = train_lifting_network(humanoid, train, sight, settings, tell)
    save_lifting_network(network, {**asdict(settings), "sight": asdict(sight)}, out / "network")
    print(f"network: {out / 'network'}")
    if not test:
        print("no source holds people out: nothing is judged")
        return
    errors = lifting_errors(network, humanoid, test, sight, _CAMERAS)
    (out / "result.json").write_text(json.dumps({"mm": errors, "seed": settings.seed}, indent=1))
    print("held-out people: " + ", ".join(f"{name} {error:.1f} mm" for name, error in errors.items()))
