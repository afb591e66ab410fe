"""From a film that was read to what a policy follows: head signal, states, and a path in the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from egopose.checkpoint.head_signal import load_head_signal_regressor
from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.inference.video_regression import crossed
from egopose.models.head_path import camera_height, path_of_signal, states_on_path
from egopose.models.head_signal_input import signal_features
from egopose.models.regressor import StateRegressor
from egopose.pipeline.regressor import joint_targets
from egopose.vision.head_film import HeadRow, WornCamera, film_camera, head_signal_of_rows, telemetry_of
from egopose.vision.head_signal import HeadSignal
from egopose.vision.lens import Camera


@dataclass(frozen=True)
class FilmReading:
    """What a film tells of its wearer.

    Args:
        signal: of the camera.
        states: ``[T, S]`` float32 humanoid states z whose root follows the camera's path.
        height: m of the camera above the floor while its wearer stands.
        notes: sentences on what had to be assumed.
    """

    signal: HeadSignal
    states: Tensor
    height: float
    notes: tuple[str, ...]


@torch.no_grad()
def read_states(
    humanoid: HumanoidModel, rows: Sequence[HeadRow], video: Path, camera: Camera, worn: WornCamera
) -> FilmReading:
    """States and signal of a film's rows.

    Args:
        humanoid: whose states they are.
        rows: of :func:`egopose.vision.head_film.head_rows`.
        video: the film, for its telemetry.
        camera: the user's settings.
        worn: how it is worn.

    Raises:
        InputError: the film is too short, or its telemetry or camera cannot be used.
    """
    if len(rows) < 2:
        raise InputError(video, "video", f"has {len(rows)} frames at 30 frames/s; at least 2 are needed")
    fps = 1.0 / humanoid.control_dt
    telemetry = telemetry_of(video, worn)
    known, guessed = film_camera(video, camera, telemetry)
    signal = head_signal_of_rows(rows, known, telemetry, worn)
    regressor = load_head_signal_regressor(humanoid)
    features = signal_features(signal, worn.mount)
    states = regressor.from_features(features[None])["humanoid_state"][0]
    height = camera_height(humanoid, worn.mount) if worn.height is None else worn.height
    path = path_of_signal(signal, states.numpy(), height, fps)
    notes = []
    if guessed:
        notes.append(
            f"the camera's field of view is not known and taken for {known.field_of_view:g} degrees: "
            "give camera.field_of_view, speeds and turns depend on it"
        )
    placed = torch.from_numpy(states_on_path(states.numpy(), path, fps)).float()
    return FilmReading(signal, placed, height, tuple(notes))


def require_states_for_context(source_config: Mapping[str, Any]) -> None:
    """See that a policy can be told what a head signal says; to be called before the film is read.

    Args:
        source_config: the groups that the run's regressor was trained with.

    Raises:
        InputError: the policy reads the flow's own context, which a head signal does not have.
    """
    if not crossed(source_config):
        cause = "the policy reads the context of its own regressor of flow: sees=flow"
        raise InputError("conf/estimate.yaml", "sees", cause)


def seen_in_film(humanoid: HumanoidModel, reading: FilmReading, regressor: StateRegressor) -> dict[str, Tensor]:
    """As :func:`egopose.inference.video_regression.seen_in`, of a film's reading.

    Args:
        humanoid: the run's.
        reading: of the film.
        regressor: the run's own, in whose units the policy reads its context (:func:`require_states_for_context`).
    """
    return {
        "visual_context": regressor.normalise(reading.states),
        "humanoid_state": reading.states,
        "joint_targets": joint_targets(reading.states, humanoid),
    }
