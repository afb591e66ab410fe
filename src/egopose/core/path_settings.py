"""Settings that are paths: what each must be, looked at once, before a verb begins.

A verb on ``conf/NAME.yaml`` is checked by :func:`~egopose.core.config.command`. Verbs that read words of their own call
:func:`check_paths` on their configuration and :func:`checked_path` on the words.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf

from egopose.core.errors import InputError

_COMMAND_LINE = "command line"


class Kind(Enum):
    """What a path must be; the value says it to a user."""

    FILE = "a file"
    FOLDER = "a folder"
    EXISTING = "a file or a folder"
    RUN = "a run directory, a checkpoint folder or pretrained:NAME"
    NEW_FILE = "a file to be written"
    NEW_FOLDER = "a folder to be written to"
    SOURCE = "a camera's number, a file, an address or take:NAME"
    PATTERN = "a file or a pattern"


#: Settings of groups, the same in every configuration that has them. ``*`` is any key of a mapping.
SHARED = {
    "data.folder": Kind.FOLDER,
    "data.store": Kind.NEW_FOLDER,
    "reader.asf": Kind.FILE,
    "data.reader.asf": Kind.FILE,
    "vision.encoder.weights": Kind.EXISTING,
    "task.clip": Kind.FOLDER,
    "task.start_from": Kind.FILE,
    "task.also.*.folder": Kind.FOLDER,
    "training.start_from": Kind.RUN,
    "resume": Kind.FOLDER,
    "output": Kind.NEW_FOLDER,
}
#: Settings of one ``conf/NAME.yaml``.
OWN = {
    "estimate": {
        "video": Kind.FILE,
        "checkpoint": Kind.RUN,
        "out": Kind.NEW_FOLDER,
        "worn.telemetry": Kind.FILE,
    },
    "evaluate": {
        "checkpoint": Kind.RUN,
        "data_folder": Kind.FOLDER,
        "out": Kind.NEW_FOLDER,
        "forecast.estimator": Kind.RUN,
        "forecast.baselines.*": Kind.FOLDER,
    },
    "stream": {
        "source": Kind.SOURCE,
        "checkpoint": Kind.RUN,
        "out": Kind.NEW_FILE,
        "forecast.checkpoint": Kind.RUN,
        "forecast.out": Kind.NEW_FILE,
    },
    "reconstruct": {
        "video": Kind.FILE,
        "poses": Kind.EXISTING,
        "scene": Kind.FILE,
        "out": Kind.NEW_FOLDER,
        "camera.track": Kind.FILE,
        "contacts.network": Kind.FOLDER,
        "policy": Kind.RUN,
    },
    "package": {"run": Kind.RUN, "out": Kind.NEW_FOLDER, "figures.*": Kind.FILE},
    "sync": {"video": Kind.FILE, "motion": Kind.FILE},
    "tracker": {"out": Kind.NEW_FOLDER},
    "body_parts": {"motions": Kind.PATTERN, "out": Kind.NEW_FOLDER},
    "contacts": {"sources.*": Kind.FOLDER, "out": Kind.NEW_FOLDER},
    "lifter": {"sources.*": Kind.FOLDER, "out": Kind.NEW_FOLDER},
    "head_signal": {"sources.*": Kind.FOLDER, "out": Kind.NEW_FOLDER},
}
#: Settings that may also be a list of paths.
LISTS = {("evaluate", "checkpoint"), ("body_parts", "motions")}


def check_paths(name: str, config: DictConfig) -> None:
    """Look at every path in a configuration of ``conf/NAME.yaml``; a leading ``~`` becomes the home directory in place.

    Values that are null or missing (``???``) are left to the verb.

    Raises:
        InputError: a path is empty, is no text, is not there or is of another kind; names the setting.
    """
    for pattern, kind in {**SHARED, **OWN.get(name, {})}.items():
        for setting in _matching(config, pattern):
            value = OmegaConf.select(config, setting, throw_on_missing=False)
            if value is None:
                continue
            if OmegaConf.is_list(value) and (name, setting) in LISTS:
                # A path at fault is named with its place in the list.
                checked: Any = [checked_path(one, kind, f"{setting}[{i}]") for i, one in enumerate(value)]
            else:
                checked = checked_path(value, kind, setting)
            if checked != value:
                OmegaConf.update(config, setting, checked)


def checked_path(value: Any, kind: Kind, setting: str) -> Any:
    """A path with ``~`` as the home directory; a camera's number and a name ``pretrained:NAME`` as they are.

    Raises:
        InputError: it is empty, no text, not there or of another kind; names ``setting``.
    """
    if kind is Kind.SOURCE and isinstance(value, int) and not isinstance(value, bool):
        return value
    if not isinstance(value, str):
        shown = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        hint = f"; for a name of digits write ./{value}" if number else ""
        raise InputError(_COMMAND_LINE, setting, f"must be {kind.value}, not {shown!r:.60}{hint}")
    if not value.strip():
        raise InputError(_COMMAND_LINE, setting, f"is empty; give {kind.value}")
    if kind in (Kind.PATTERN, Kind.SOURCE) or (kind is Kind.RUN and ":" in value):
        return value
    try:
        path = Path(value).expanduser()
        fault = _fault(path, kind)
    except (OSError, RuntimeError, ValueError) as error:  # too long, no right to look, no such user, a NUL
        raise InputError(_shown(value), setting, getattr(error, "strerror", None) or str(error)) from None
    if fault is not None:
        raise InputError(value, setting, fault)
    return str(path) if value.startswith("~") else value


def check_run_directory(arguments: Sequence[str]) -> None:
    """``resume`` and ``output`` among the words of a command, before Hydra makes the run directory that they name.

    Raises:
        InputError: one is empty, not there or of another kind, or ``resume`` is no run directory.
    """
    for word in arguments:
        name, equals, _ = word.partition("=")
        if name not in ("resume", "output") or not equals:
            continue
        try:
            value = OverridesParser.create().parse_override(word).value()
        except OverrideParseException:  # Hydra tells it
            continue
        if value is None:
            continue
        folder = Path(checked_path(value, SHARED[name], name))
        if name == "resume" and not (folder / "config.yaml").is_file() and not (folder / "checkpoints").is_dir():
            raise InputError(folder, "config.yaml", "is missing: this is no run directory")


def _fault(path: Path, kind: Kind) -> str | None:
    """What is wrong with it, None for nothing."""
    there, folder = path.exists(), path.is_dir()
    if kind in (Kind.FILE, Kind.NEW_FILE) and folder:
        return f"is a folder; give {kind.value}"
    if kind in (Kind.FOLDER, Kind.RUN, Kind.NEW_FOLDER) and there and not folder:
        return f"is a file; give {kind.value}"
    if kind in (Kind.NEW_FILE, Kind.NEW_FOLDER):
        above = next(parent for parent in [*path.absolute().parents] if parent.exists())
        return None if above.is_dir() else f"cannot be made: {above} is a file"
    if there:
        return None
    return "no such file or folder" if kind is Kind.EXISTING else f"no such {'file' if kind is Kind.FILE else 'folder'}"


def _shown(text: str) -> str:
    """A path that cannot be used, short enough for one line."""
    return text if len(text) <= 80 else f"{text[:77]}..."


def _matching(config: DictConfig, pattern: str) -> Iterator[str]:
    """The settings that a pattern names in this configuration."""
    before, star, after = pattern.partition(".*")
    if not star:
        yield pattern
        return
    inner = OmegaConf.select(config, before, throw_on_missing=False)
    for key in inner if OmegaConf.is_dict(inner) else ():
        yield f"{before}.{key}{after}"
