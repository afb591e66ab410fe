"""Where takes come from: the embedded clips, a folder or table of mocap files, or a user's list of motion and video."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any

from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.data.table_sources import table_rows
from egopose.motion.io import given_options
from egopose.vision.lens import Camera

_MAX_FILES = 100_000


@dataclass(frozen=True)
class TakeSource:
    """One take before anything is read.

    Args:
        name: of the take.
        subject: whose motion.
        motion: file to read.
        options: for the reader (``unit``, ``up``, ``asf`` ...).
        video: the wearer's MP4, or None to render one.
        sync_offset: s, see :class:`egopose.data.store.TakeInfo`; None: to be found (:mod:`egopose.data.sync_offset`).
        mapping: part -> joint for skeletons whose names say too little.
        camera: that took the video, or None where nothing is known of it.
        group: of takes that ``data.shares`` names together.
        part: ``train`` or ``test``, where the set says so of each take.
        skip: frames before the motion, which are cut.
        facts: what the set says of the file, see :func:`egopose.data.source_reading.read_source`.
    """

    name: str
    subject: str
    motion: Path
    options: dict[str, Any]
    video: Path | None = None
    sync_offset: float | None = 0.0
    mapping: dict[str, str] | None = None
    camera: Camera | None = None
    group: str = ""
    part: str = ""
    skip: int = 0
    facts: dict[str, Any] = field(default_factory=dict)


def find_sources(settings: Mapping[str, Any]) -> list[TakeSource]:
    """The takes of a ``conf/data`` group.

    Args:
        settings: ``source``: ``embedded``, ``folder`` (``folder``, ``pattern``: a glob; ``subject``: a regular
            expression whose first group is the subject), ``table`` (see :mod:`egopose.data.table_sources`) or ``takes``
            (a list of ``{motion, video, sync_offset, subject, name, reader, mapping, camera}``); ``exclude``: take
            names left out; ``reader``: options for the reader; ``camera``: of every take that does not say otherwise.

    Raises:
        InputError: a file is missing or nothing is found; names the field.
    """
    kind = settings.get("source")
    if kind == "embedded":
        result = _in_folder(Path(str(files("egopose") / "assets" / "clips")), settings)
    elif kind == "folder":
        if not settings.get("folder"):
            raise InputError(
                "data", "folder", f"say where the set lies: data.folder=PATH ({settings.get('about', '')})"
            )
        result = _in_folder(Path(str(settings["folder"])).expanduser(), settings)
    elif kind == "table":
        result = _in_table(settings)
    elif kind == "takes":
        result = _listed(
            settings.get("takes"),
            given_options(_options(settings.get("reader"), "data.reader")),
            _options(settings.get("camera"), "data.camera"),
        )
    else:
        raise InputError("data", "source", f"must be embedded, folder, table or takes, not {kind!r}")
    names = [s.name for s in result]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise InputError("data", "takes", f"names stand twice: {', '.join(twice)}")
    return result


def _in_folder(folder: Path, settings: Mapping[str, Any]) -> list[TakeSource]:
    if not folder.is_dir():
        raise InputError(folder, "data.folder", "is not a folder")
    excluded = {str(name) for name in convert(settings.get("exclude") or [], tuple[Any, ...], "data", "data.exclude")}
    subject, reader = (
        _expression(settings.get("subject")),
        given_options(_options(settings.get("reader"), "data.reader")),
    )
    pattern = convert(settings.get("pattern"), str, "data", "data.pattern")
    try:
        paths = sorted(islice(folder.glob(pattern), _MAX_FILES))
    except (ValueError, NotImplementedError, IndexError, OSError) as error:
        raise InputError("data", "data.pattern", f"{pattern!r:.60} cannot be looked for: {error}"[:200]) from None
    out = []
    for path in paths:
        name = path.name.split(".")[0]
        if name in excluded:
            continue
        match = subject.match(name)
        if match is None:
            raise InputError(path, "data.subject", f"{settings['subject']!r} does not match {name!r}")
        out.append(TakeSource(name, match[1], path, dict(reader)))
    if not out:
        raise InputError(folder, "data.pattern", f"{pattern!r:.60} matches no file")
    return out


def _in_table(settings: Mapping[str, Any]) -> list[TakeSource]:
    reader = given_options(_options(settings.get("reader"), "data.reader"))
    rows = [row for row in table_rows(settings) if not row.reason]
    if not rows:
        raise InputError("data", "data.leave_out", "leaves no clip of the table")
    if missing := [row for row in rows if not row.file.is_file()]:
        cause = f"{len(missing)} of {len(rows)} files of the table are not there: unpack the set's archives there"
        raise InputError(missing[0].file, "data.folder", cause)
    return [
        TakeSource(
            row.name,
            row.subject,
            row.file,
            dict(reader),
            group=row.group,
            part=row.part,
            skip=row.skip,
            facts={name: value for name, value in row.facts.items() if name not in reader},
        )
        for row in rows
    ]


def _expression(text: Any) -> re.Pattern[str]:
    """``data.subject``, which must not be one that takes for ever on a long name."""
    text = convert(text, str, "data", "data.subject")
    # A repeated group, or many repetitions in a row, is tried in exponentially many ways.
    if len(text) > 200 or re.search(r"\)[*+?{]", text) or len(re.findall(r"(?<!\()(?<![*+?}])[*+?{]", text)) > 3:
        cause = f"{text!r:.60}: at most 200 characters, three repetitions and no repeated group are tried"
        raise InputError("data", "data.subject", cause)
    try:
        expression = re.compile(text)
    except (re.error, OverflowError, RecursionError) as error:
        raise InputError("data", "data.subject", f"{text!r:.60} is no regular expression: {error}") from None
    if not expression.groups:
        raise InputError("data", "data.subject", f"{text!r:.60} has no group (...) for the subject's name")
    return expression


def _options(value: Any, field: str) -> dict[str, Any]:
    if value is not None and not isinstance(value, Mapping):
        raise InputError("data", field, f"must be a mapping, not {value!r:.60}")
    return {str(key): option for key, option in (value or {}).items()}


_TAKE_SETTINGS = {"motion", "video", "sync_offset", "subject", "name", "reader", "mapping", "camera"}


def _listed(rows: Any, reader: dict[str, Any], camera: dict[str, Any]) -> list[TakeSource]:
    if not isinstance(rows, Sequence) or isinstance(rows, str):
        raise InputError("data", "data.takes", f"must be a list of {{motion: FILE, ...}}, not {rows!r:.60}")
    out = []
    for number, row in enumerate(rows):
        label = f"data.takes[{number}]"
        if not isinstance(row, Mapping):
            raise InputError("data", label, f"must be {{motion: FILE, ...}}, not {row!r:.60}")
        if unknown := set(row) - _TAKE_SETTINGS:
            cause = (
                f"has no setting {sorted(map(str, unknown))[0]!r:.60}; there are {', '.join(sorted(_TAKE_SETTINGS))}"
            )
            raise InputError("data", label, cause)
        for key in ("motion", "video"):
            if row.get(key) is not None and (not isinstance(row[key], str) or "\0" in row[key]):
                raise InputError("data", f"{label}.{key}", f"must be a path, not {row[key]!r:.60}")
            if row.get(key) and not _is_file(row[key]):
                raise InputError(row[key], f"{label}.{key}", "there is no such file")
        if not row.get("motion"):
            raise InputError("data", f"{label}.motion", "is missing")
        motion = Path(row["motion"]).expanduser()
        name = str(row.get("name") or motion.name.split(".")[0])
        if name in (".", "..") or re.search(r"[/\\\0]", name):
            raise InputError("data", f"{label}.name", f"{name!r} cannot be the name of a file")
        filmed = Camera.from_mapping({**camera, **_options(row.get("camera"), f"{label}.camera")}, f"{label}.camera")
        out.append(
            TakeSource(
                name,
                str(row.get("subject", "1")),
                motion,
                {**reader, **given_options(_options(row.get("reader"), f"{label}.reader"))},
                Path(row["video"]).expanduser().resolve() if row.get("video") else None,
                _sync_offset(row, label),
                _options(row["mapping"], f"{label}.mapping") if row.get("mapping") else None,
                filmed if row.get("video") and filmed != Camera() else None,
            )
        )
    if not out:
        raise InputError(
            "data",
            "takes",
            "the list is empty; give data.takes=[{motion: FILE}], or a file of takes as docs/own-data.md shows",
        )
    return out


def _sync_offset(row: Mapping[str, Any], label: str) -> float | None:
    value = row.get("sync_offset", 0.0)
    if value == "auto":
        if not row.get("video"):
            raise InputError("data", f"{label}.sync_offset", "auto needs a video to look in")
        return None
    try:
        return float(convert(value, float, "data", f"{label}.sync_offset"))
    except InputError as error:
        raise InputError("data", error.field, f"{error.cause} (seconds, or auto to have it found)") from None


def _is_file(text: str) -> bool:
    try:
        return Path(text).expanduser().is_file()
    except (OSError, RuntimeError, ValueError):  # a name too long, a home that is not there, a lone surrogate
        return False
