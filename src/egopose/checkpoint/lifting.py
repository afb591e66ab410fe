"""The network that lifts 2D keypoints: the one that comes with the package, and how one is saved and loaded."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egopose.checkpoint.checkpoint import RunCheckpoint, metadata_of, read_json
from egopose.checkpoint.pretrained import FOLDER
from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.scene.lifting import JOINTS, LiftingNetwork

_KIND = "lifting network"
_NAME = "lifter"
_MOST = {"width": 65_536, "blocks": 64}


def save_lifting_network(network: LiftingNetwork, settings: Mapping[str, Any], folder: Path) -> None:
    """Write a network to ``folder`` with the settings that made it; ``width`` and ``blocks`` are its layers'."""
    metadata = metadata_of(_KIND, len(JOINTS), 0, 0, 0.0)
    RunCheckpoint({"network": network, "config": dict(settings)}).save(folder, metadata=metadata)


@functools.cache
def load_lifting_network(folder: Path | None = None) -> LiftingNetwork:
    """A saved network, in evaluation mode.

    Args:
        folder: where it lies; None for the one that comes with the package.

    Raises:
        InputError: there is none, or a file of it is damaged.
    """
    folder = FOLDER / _NAME if folder is None else folder
    if not (folder / "manifest.json").is_file():
        raise InputError(folder, _KIND, "is not there: egopose train --config-name lifter makes one")
    config = read_json(folder, "config")
    sizes = {name: convert(config.get(name), int, str(folder), name) for name in _MOST}
    for name, size in sizes.items():
        if not 1 <= size <= _MOST[name]:
            raise InputError(folder, name, f"cannot be that of a {_KIND}: {size}")
    network = LiftingNetwork(**sizes)
    RunCheckpoint({"network": network}).restore(folder, {"network"})
    return network.eval()
