"""Takes that a table lists: a CSV file with a row a clip says whose it is, what it is for and how its file is read."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from egopose.core.config import convert, from_mapping
from egopose.core.errors import InputError
from egopose.data.store import PARTS, LeftOut

#: The largest table read, bytes: some fifty thousand clips.
_MAX_BYTES = 16 * 2**20


@dataclass(frozen=True)
class TableColumns:
    """Which column of the table says what; None where none does. ``data.columns``.

    Args:
        file: the motion file, from ``data.folder`` on.
        subject: whose motion it is.
        group: what ``data.shares`` names: takes of one source or licence.
        fps, unit, up, frames: what the file should have: frames per second, metres a unit, up axis, frames.
        skip: frames before the motion, which are cut.
        split: ``train`` or ``test``.
    """

    file: str
    subject: str
    group: str | None = None
    fps: str | None = None
    unit: str | None = None
    up: str | None = None
    frames: str | None = None
    skip: str | None = None
    split: str | None = None


@dataclass(frozen=True)
class TableRow:
    """What the table says of one clip; None or empty where it says nothing. See :class:`TableColumns`."""

    name: str
    file: Path
    subject: str
    group: str
    part: str
    skip: int
    fps: float | None
    unit: float | None
    up: str | None
    frames: int | None
    reason: str = ""

    @property
    def facts(self) -> dict[str, Any]:
        """What the table says of the file, for comparison with what its reader finds."""
        values = {"fps": self.fps, "unit": self.unit, "up": self.up, "frames": self.frames}
        return {name: value for name, value in values.items() if value is not None}


def table_rows(settings: Mapping[str, Any]) -> list[TableRow]:
    """The rows of a set's table, those left out too; these have a ``reason``.

    Args:
        settings: of ``conf/data``: ``folder``; ``table``, a path from there on; ``columns``, see
            :class:`TableColumns`; ``where``: ``{column: [values]}``, rows with other values belong to other sets;
            ``leave_out``: ``{column: reason}``, rows that have something in that column are left out.

    Raises:
        InputError: the table is missing, lacks a column, or a row is wrong; names the line.
    """
    if not settings.get("folder"):
        raise InputError("data", "folder", f"say where the set lies: data.folder=PATH ({settings.get('about', '')})")
    folder = Path(str(settings["folder"])).expanduser()
    path = folder / Path(convert(settings.get("table"), str, "data", "data.table")).expanduser()
    columns = from_mapping(TableColumns, _mapping(settings, "columns"), "data.columns")
    where = {column: _texts(values, column) for column, values in _mapping(settings, "where").items()}
    reasons = {column: str(reason) for column, reason in _mapping(settings, "leave_out").items()}
    lines = _lines(path, {*(c for f in fields(columns) if (c := getattr(columns, f.name))), *where, *reasons})
    stems = Counter(Path(line[columns.file]).name.split(".")[0] for _, line in lines)
    rows = [
        _row(path, number, line, columns, folder, stems, reasons)
        for number, line in lines
        if all(line[column] in values for column, values in where.items())
    ]
    if not rows:
        raise InputError(path, "data.where", f"no row has {dict(where)}")
    _one_part_a_person(path, rows)
    return rows


def left_out_rows(settings: Mapping[str, Any]) -> list[LeftOut]:
    """Clips that a set's table lists and the set leaves out, with the reason; none for sets without a table."""
    if settings.get("source") != "table":
        return []
    return [
        LeftOut(row.name, row.subject, row.reason, row.frames / row.fps if row.frames and row.fps else None)
        for row in table_rows(settings)
        if row.reason
    ]


def _mapping(settings: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = settings.get(key) or {}
    if not isinstance(value, Mapping):
        raise InputError("data", f"data.{key}", f"must be a mapping, not {value!r:.60}")
    return {str(name): entry for name, entry in value.items()}


def _texts(values: Any, column: str) -> set[str]:
    return {str(v) for v in convert(values, tuple[Any, ...], "data", f"data.where.{column}")}


def _lines(path: Path, needed: set[str]) -> list[tuple[int, dict[str, str]]]:
    """Number and cells of the table's lines."""
    if not path.is_file():
        raise InputError(path, "data.table", "there is no such file: give data.table=PATH, from data.folder on")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(path, "data.table", f"has {path.stat().st_size} bytes; at most {_MAX_BYTES} are read")
    try:
        reader = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"), newline=""), restval="", strict=True)
        lines = [(reader.line_num, line) for line in reader]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(path, "data.table", f"cannot be read: {error}"[:200]) from None
    names = reader.fieldnames or []
    if missing := sorted(needed - set(names)):
        raise InputError(path, "data.columns", f"no column {missing[0]!r:.60}; there are {', '.join(names)}"[:300])
    for number, line in lines:
        if None in line:
            raise InputError(path, f"line {number}", f"has more cells than the {len(names)} columns")
    return [(number, {name: cell.strip() for name, cell in line.items()}) for number, line in lines]


def _row(
    path: Path,
    number: int,
    line: Mapping[str, str],
    columns: TableColumns,
    folder: Path,
    stems: Mapping[str, int],
    reasons: Mapping[str, str],
) -> TableRow:
    def cell(name: str) -> str:
        column = getattr(columns, name)
        return line[column] if column else ""

    def number_of(name: str, least: float, whole: bool = False) -> float | None:
        if not cell(name):
            return None
        try:
            value = float(cell(name))
        except ValueError:
            value = float("nan")
        if not least <= value < 1e9 or (whole and value != int(value)):
            cause = f"must be a {'whole ' if whole else ''}number of at least {least:g}, not {cell(name)!r:.60}"
            raise InputError(path, f"line {number}, {getattr(columns, name)}", cause)
        return value

    for name in ("file", "subject"):
        if not cell(name):
            raise InputError(path, f"line {number}, {getattr(columns, name)}", "is empty")
    if cell("split") not in ("", *PARTS):
        cause = f"must be {' or '.join(PARTS)}, not {cell('split')!r:.60}"
        raise InputError(path, f"line {number}, {columns.split}", cause)
    file = Path(cell("file"))
    if file.is_absolute() or ".." in file.parts:
        raise InputError(path, f"line {number}, {columns.file}", f"{cell('file')!r:.60} lies outside data.folder")
    stem = file.name.split(".")[0]
    frames, skip = number_of("frames", 1, True), number_of("skip", 0, True)
    return TableRow(
        name=stem if stems[stem] == 1 else "-".join([*file.parent.parts, stem]),
        file=folder / file,
        subject=cell("subject"),
        group=cell("group"),
        part=cell("split"),
        skip=int(skip or 0),
        fps=number_of("fps", 1.0),
        unit=number_of("unit", 1e-6),
        up=cell("up").lower() or None,
        frames=None if frames is None else int(frames),
        reason="; ".join(reason for column, reason in reasons.items() if line[column]),
    )


def _one_part_a_person(path: Path, rows: list[TableRow]) -> None:
    """Whoever is tested on is not trained on."""
    parts: dict[str, str] = {}
    for row in rows:
        if not row.reason and parts.setdefault(row.subject, row.part) != row.part:
            raise InputError(path, f"split of {row.subject}", "must be the same in all rows: people train or test")
