"""Where the configuration files lie, and the settings that stand in them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from egopose.core.errors import InputError


def config_dir() -> Path:
    """The folder of Hydra groups: inside the installed package, or ``conf/`` of the checkout it was installed from.

    Raises:
        InputError: neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    for place in (package / "conf", package.parents[1] / "conf"):
        if (place / "train.yaml").is_file():
            return place
    raise InputError(package / "conf", "train.yaml", "the configuration is missing: the installation is incomplete")


def setting_names(verb: str) -> list[str]:
    """All settings and groups of ``conf/VERB.yaml``, as they are given on the command line."""
    folder = config_dir()
    groups = _groups(folder, verb)
    return sorted({*groups, *(key.rstrip("=") for key in _settings(folder, verb, groups))})


def _load(path: Path) -> dict[str, Any]:
    """One of the package's own files, interpolations as they stand."""
    values = yaml.safe_load(path.read_text())
    return {str(key): value for key, value in values.items()} if isinstance(values, dict) else {}


def _groups(folder: Path, verb: str) -> dict[str, str | None]:
    """Groups of a verb's configuration and the choice each has by default."""
    entries = [entry for entry in _load(folder / f"{verb}.yaml").get("defaults", []) if isinstance(entry, dict)]
    return {g: choice for entry in entries for g, choice in entry.items() if not g.startswith("override ")}


def _settings(folder: Path, verb: str, groups: dict[str, str | None]) -> Iterator[str]:
    """Every ``key=`` of the verb's own file and of its groups' choices."""
    yield from _keys(_load(folder / f"{verb}.yaml"), "")
    for group, choice in groups.items():
        yield from _choice(folder, group, f"{choice}", f"{group}.")


def _choice(folder: Path, group: str, choice: str, prefix: str) -> Iterator[str]:
    """Of one file of a group, and of those it builds on."""
    path = folder / group / f"{choice}.yaml"
    if not path.is_file():
        return
    values = _load(path)
    yield from _keys(values, prefix)
    for base in values.get("defaults", []):
        if isinstance(base, dict):  # {/group@package: choice}
            for name, chosen in base.items():
                other, _, package = name.lstrip("/").partition("@")
                yield from _choice(folder, other, str(chosen), f"{prefix}{package}.")
        elif base != "_self_":
            yield from _choice(folder, group, str(base), prefix)


def _keys(values: dict[str, Any], prefix: str) -> Iterator[str]:
    for key, value in values.items():
        if key in ("defaults", "hydra"):
            continue
        if isinstance(value, dict) and value:
            yield from _keys(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}="
