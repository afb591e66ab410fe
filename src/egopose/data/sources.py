"""Where takes come from: the embedded clips, a folder of mocap files, or a user's own list of motion and video."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from egopose.config import convert
from egopose.errors import InputError


@dataclass(frozen=True)
class TakeSource:
    """One take before anything is read.

    Args:
        name: of the take.
        subject: whose motion.
        motion: file to read.
        options: for the reader (``unit``, ``up``, ``asf`` ...).
        video: the wearer's MP4, or None to render one.
        sync_offset: s, see :class:`egopose.data.store.TakeInfo`.
        mapping: part -> joint for skeletons whose names say too little.
    """

    name: str
    subject: str
    motion: Path
    options: dict[str, Any]
    video: Path | None = None
    sync_offset: float = 0.0
    mapping: dict[str, str] | None = None


def find_sources(settings: Mapping[str, Any]) -> list[TakeSource]:
    """The takes of a ``conf/data`` group.

    Args:
        settings: ``source``: ``embedded``, ``folder`` (``folder``, ``pattern``: a glob; ``subject``: a regular
            expression whose first group is the subject) or ``takes`` (a list of ``{motion, video, sync_offset, subject,
            name}``); ``exclude``: take names left out; ``reader``: options for the reader.

    Raises:
        InputError: a file is missing or nothing is found; names the field.
    """
    kind = settings["source"]
    if kind == "embedded":
        found = _in_folder(Path(str(files("egopose") / "assets" / "clips")), settings)
    elif kind == "folder":
        if not settings.get("folder"):
            raise InputError(
                "data", "folder", f"say where the set lies: data.folder=PATH ({settings.get('about', '')})"
            )
        found = _in_folder(Path(str(settings["folder"])).expanduser(), settings)
    elif kind == "takes":
        found = _listed(settings["takes"], dict(settings.get("reader") or {}))
    else:
        raise InputError("data", "source", f"must be embedded, folder or takes, not {kind!r}")
    names = [s.name for s in found]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise InputError("data", "takes", f"names stand twice: {', '.join(twice)}")
    return found


def _in_folder(folder: Path, settings: Mapping[str, Any]) -> list[TakeSource]:
    if not folder.is_dir():
        raise InputError(folder, "data.folder", "is not a folder")
    excluded = set(settings.get("exclude") or ())
    try:
        subject = re.compile(settings["subject"])
    except re.error as error:
        raise InputError("data", "data.subject", f"{settings['subject']!r} is no regular expression: {error}") from None
    if not subject.groups:
        raise InputError("data", "data.subject", f"{settings['subject']!r} has no group (...) for the subject's name")
    out = []
    for path in sorted(folder.glob(settings["pattern"])):
        name = path.name.split(".")[0]
        if name in excluded:
            continue
        match = subject.match(name)
        if match is None:
            raise InputError(path, "data.subject", f"{settings['subject']!r} does not match {name!r}")
        out.append(TakeSource(name, match[1], path, dict(settings.get("reader") or {})))
    if not out:
        raise InputError(folder, "data.pattern", f"{settings['pattern']!r} matches no file")
    return out


def _listed(rows: Sequence[Mapping[str, Any]], reader: dict[str, Any]) -> list[TakeSource]:
    out = []
    for number, row in enumerate(rows):
        label = f"data.takes[{number}]"
        if not isinstance(row, Mapping):
            raise InputError("data", label, f"must be {{motion: FILE, ...}}, not {row!r}")
        if unknown := set(row) - {"motion", "video", "sync_offset", "subject", "name", "reader", "mapping"}:
            raise InputError("data", label, f"has no setting {sorted(unknown)[0]!r}")
        for key in ("motion", "video"):
            if row.get(key) and not Path(row[key]).expanduser().is_file():
                raise InputError(row[key], f"{label}.{key}", "there is no such file")
        if not row.get("motion"):
            raise InputError("data", f"{label}.motion", "is missing")
        motion = Path(row["motion"]).expanduser()
        name = str(row.get("name") or motion.name.split(".")[0])
        if name in (".", "..") or re.search(r"[/\\\0]", name):
            raise InputError("data", f"{label}.name", f"{name!r} cannot be the name of a file")
        out.append(
            TakeSource(
                name,
                str(row.get("subject", "1")),
                motion,
                {**reader, **(row.get("reader") or {})},
                Path(row["video"]).expanduser().resolve() if row.get("video") else None,
                convert(row.get("sync_offset", 0.0), float, "data", f"{label}.sync_offset"),
                dict(row["mapping"]) if row.get("mapping") else None,
            )
        )
    if not out:
        raise InputError("data", "takes", "the list is empty")
    return out
