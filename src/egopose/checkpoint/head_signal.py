"""The state regressor of head signals that comes with the package, and how one is saved."""

from __future__ import annotations

import functools
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from egopose.checkpoint.checkpoint import RunCheckpoint, metadata_of, read_json
from egopose.checkpoint.pretrained import FOLDER
from egopose.core.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.models.head_signal_input import SIGNAL_FEATURES
from egopose.models.regressor import StateRegressor

_NAME = "head_signal"


def load_head_signal_regressor(humanoid: HumanoidModel, folder: Path | None = None) -> StateRegressor:
    """A regressor of head signals, in evaluation mode.

    Args:
        humanoid: whose states it must give.
        folder: where it lies; None for the one that comes with the package.

    Raises:
        InputError: there is none, a file of it is damaged, or it is of another skeleton.
    """
    model, names = _load(FOLDER / _NAME if folder is None else folder)
    if list(humanoid.skeleton.names) != names:
        cause = "is of another skeleton than the checkpoint's: sees=flow takes the checkpoint's own regressor"
        raise InputError(folder or _NAME, "skeleton", cause)
    return model


@functools.cache
def _load(folder: Path) -> tuple[StateRegressor, list[str]]:
    if not (folder / "manifest.json").is_file():
        raise InputError(folder, "regressor of head signals", "is not there")
    config = read_json(folder, "config")
    size = int(config["state_size"])
    hidden = tuple(int(width) for width in config["hidden"])
    zeros, ones, context = torch.zeros(size), torch.ones(size), int(config["context_size"])
    # Dropout does nothing in evaluation, but its layers count in the names of those behind it.
    model = StateRegressor(None, zeros, ones, SIGNAL_FEATURES, context, hidden, float(config["dropout"]))
    RunCheckpoint({"regressor": model}).restore(folder, {"regressor"})
    return model.eval(), [str(name) for name in config["skeleton"]]


def save_head_signal_regressor(model: StateRegressor, humanoid: HumanoidModel, settings: Any, folder: Path) -> None:
    """Write a regressor to ``folder``.

    Args:
        model: trained.
        humanoid: whose states it gives.
        settings: a dataclass with ``context_size``, ``hidden`` and ``dropout``, kept as it is.
        folder: to be written.
    """
    size = len(model.state_mean)
    config = {**asdict(settings), "state_size": size, "skeleton": list(humanoid.skeleton.names)}
    metadata = metadata_of("head signal regressor", size, 0, 0, 0.0)
    RunCheckpoint({"regressor": model, "config": config}).save(folder, metadata=metadata)
