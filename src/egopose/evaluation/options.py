"""``python -m egopose.evaluate checkpoint=RUN_OR_CHECKPOINT [split=test] [out=DIR]``: score a policy beside PoseReg."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from egopose.checkpoint import pretrained as weights
from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.config import compose_config
from egopose.core.errors import InputError


def output_folder(out: str | None, checkpoint: Path, split: str) -> Path:
    """Where results go: ``out``, or ``RUN/evaluation/SPLIT``; ``evaluation/NAME/SPLIT`` here for ``pretrained:NAME``.

    Raises:
        InputError: ``out`` lies inside the checkpoint, whose files are sealed by checksums.
    """
    run = checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else checkpoint.parent
    # The package is no place for results.
    beside = Path("evaluation") / run.name if run.resolve().parent == weights.FOLDER else run / "evaluation"
    folder = beside / split if out is None else Path(out)
    if folder.resolve().is_relative_to(checkpoint.resolve()):
        raise InputError(folder, "out", "lies inside the checkpoint; choose another folder")
    return folder


def physics_group(name: str | None) -> dict[str, Any] | None:
    """The config group ``sim`` of that name, to score on other physics than a run was trained in; None for the run's.

    Raises:
        InputError: there is no such group.
    """
    return None if name is None else {"sim": compose_config("prepare", [f"sim={name}"])["sim"]}


def data_at(folder: str | None, checkpoint: str, which: str) -> dict[str, Any]:
    """The run's own config group ``data`` with its folder there, to be an override; empty for None.

    Raises:
        InputError: None for pretrained weights, which name no folder of this machine; the checkpoint cannot be read.
    """
    if folder is None and not weights.is_pretrained(checkpoint):
        return {}
    data = read_json(find_checkpoint(checkpoint, which), "config")["data"]
    if folder is None:
        raise InputError(
            checkpoint, "data_folder", f"say where the set lies: data_folder=PATH ({data.get('about', '')})"
        )
    return {"data": {**data, "folder": str(Path(folder).expanduser().resolve())}}
