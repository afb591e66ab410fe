"""How a contact network is saved and loaded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egopose.checkpoint.checkpoint import RunCheckpoint, metadata_of, read_json
from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.scene.contacts import FEET, ContactNetwork
from egopose.scene.window_contacts import WindowNetwork

_KIND = "contact network"
_MOST_UNITS = 65_536
#: By the setting ``network``.
_NETWORKS: dict[str, type[ContactNetwork] | type[WindowNetwork]] = {
    "temporal": ContactNetwork,
    "windows": WindowNetwork,
}


def save_contact_network(network: ContactNetwork | WindowNetwork, settings: Mapping[str, Any], folder: Path) -> None:
    """Write a network to ``folder`` with the settings that made it: ``network`` is its kind, ``widths`` its layers."""
    metadata = metadata_of(_KIND, len(FEET), 0, 0, 0.0)
    RunCheckpoint({"network": network, "config": dict(settings)}).save(folder, metadata=metadata)


def load_contact_network(folder: Path) -> ContactNetwork | WindowNetwork:
    """A saved network, in evaluation mode.

    Raises:
        InputError: there is none, or a file of it is damaged.
    """
    if not (folder / "manifest.json").is_file():
        raise InputError(folder, _KIND, "is not there: egopose train --config-name contacts makes one")
    config = read_json(folder, "config")
    kind = convert(config.get("network"), str, str(folder), "network")
    if kind not in _NETWORKS:
        raise InputError(folder, "network", f"{kind!r:.40} is no {_KIND}; there are {', '.join(_NETWORKS)}")
    widths = convert(config.get("widths"), tuple[int, ...], str(folder), "widths")
    if not widths or min(widths) < 1 or max(widths) > _MOST_UNITS or len(widths) > (1 if kind == "temporal" else 16):
        raise InputError(folder, "widths", f"cannot be those of a {_KIND}: {widths}")
    network = _NETWORKS[kind](widths)
    RunCheckpoint({"network": network}).restore(folder, {"network"})
    return network.eval()
