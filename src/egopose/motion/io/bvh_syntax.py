"""BVH text to numbers, in the file's own units and axes.

The parser keeps its own stack, so nesting costs no recursion, and compares what is announced with the bytes that are
there before it makes room for anything.
"""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.io._files import MAX_JOINTS, check_values, excerpt, numbers_apart, read_text
from egopose.motion.rotations import Array

_MOTION = re.compile(r"^[ \t]*MOTION[ \t]*$", re.MULTILINE | re.IGNORECASE)
_EXPECTED = "expected JOINT, End Site, OFFSET, CHANNELS, '{' or '}'"
_END = ("END", "ENDSITE", "END_SITE", "END-SITE")
_COMMENT = ("#", "//", ";")
_FIELD = re.compile(r"(frames|frame[ \t_]*time)[ \t]*(:|[ \t])[ \t]*(.*)", re.IGNORECASE)
_CHANNELS = {f"{axis}{kind}" for axis in "xyz" for kind in ("position", "rotation")}

#: Coordinates beyond this (in any unit) are no person's.
_MAX_VALUE = 1e7

#: Characters of a hierarchy: 2048 joints take about 400 kB. Its words are taken one by one.
_MAX_HIERARCHY = 4 * 2**20
_MAX_HIERARCHY_LINE = 16 * 1024

#: End Sites in sum.
_MAX_TIPS = 4 * MAX_JOINTS

#: Frames from which on one more or fewer than announced is a writer's slip.
_LEAST_FOR_A_SLIP = 10

#: Characters a written number may take: the longest double is 24.
_MAX_NUMBER_CHARACTERS = 64


@dataclass
class BvhJoint:
    """A joint as written: ``channels`` are lower case, ``"xposition"`` ... ``"zrotation"``, in the file's order."""

    name: str
    parent: int
    line: int
    offset: tuple[float, float, float] | None = None
    channels: tuple[str, ...] | None = None
    tips: list[tuple[float, float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class BvhFile:
    """``joints``, seconds a frame as written, and ``values [T, C]`` for all channels in order (degrees for rotations).

    ``notes``: sentences on what was read otherwise than it is written.
    """

    joints: list[BvhJoint]
    frame_time: str
    values: Array
    notes: list[str]


def parse_bvh(path: Path, encoding: str = "auto", timed: bool = True) -> BvhFile:
    """Read a BVH file.

    Args:
        path: the file.
        encoding: see :func:`read_text`.
        timed: whether its frame time must be a time; not where the rate is known from elsewhere.

    Raises:
        InputError: names the file, the line and what is wrong there.
    """
    text = read_text(path, encoding=encoding)
    motion = _MOTION.search(text)
    if motion is None:
        raise InputError(path, f"line {text.count(chr(10)) + 1}", "no MOTION section: not a BVH file, or cut short")
    joints = _parse_hierarchy(path, text, motion.start())
    notes: list[str] = []
    frame_time, values = _parse_motion(path, text, motion.end(), joints, timed, notes)
    return BvhFile(joints, frame_time, values, notes)


def _parse_hierarchy(path: Path, text: str, end: int) -> list[BvhJoint]:
    joints: list[BvhJoint] = []
    names: dict[str, int] = {}
    stack: list[int] = []  # open braces: joint indices, -1 for an End Site
    pending: int | None = None  # a joint or End Site announced, its brace not yet seen
    started = closed = False
    start, number, tips = 0, 0, 0
    if end > _MAX_HIERARCHY:
        raise InputError(path, "MOTION", f"stands behind {end} characters: more than any hierarchy takes")
    while start < end:
        stop = text.find("\n", start, end)
        stop = end if stop < 0 else stop
        number += 1
        where = f"line {number}"
        if stop - start > _MAX_HIERARCHY_LINE:
            raise InputError(path, where, f"{stop - start} characters long: not a line of a BVH hierarchy")
        tokens = text[start:stop].replace("{", " { ").replace("}", " } ").split()
        start = stop + 1
        if tokens and tokens[0].startswith(_COMMENT):
            continue
        while tokens:
            word = tokens.pop(0)
            key = word.upper()
            if not started:
                if key != "HIERARCHY":
                    raise InputError(path, where, f"expected HIERARCHY, found {excerpt(word)}: not a BVH file")
                started = True
            elif word == "{":
                if pending is None:
                    raise InputError(path, where, "'{' without a ROOT, JOINT or End Site before it")
                stack.append(pending)
                pending = None
            elif pending is not None:
                raise InputError(path, where, f"expected '{{', found {excerpt(word)}")
            elif word == "}":
                if not stack:
                    raise InputError(path, where, "'}' without a '{' before it")
                top = stack.pop()
                if top >= 0 and joints[top].offset is None:
                    raise InputError(path, where, f"joint {joints[top].name!r} has no OFFSET")
                closed = not stack
            elif key in ("ROOT", "JOINT"):
                cut = tokens.index("{") if "{" in tokens else len(tokens)
                name, tokens = " ".join(tokens[:cut]), tokens[cut:]
                if not name:
                    raise InputError(path, where, f"{key} without a name")
                if (key == "ROOT") != (not joints) or closed:
                    raise InputError(path, where, "one ROOT must stand first and hold everything else")
                if joints and (not stack or stack[-1] < 0):
                    raise InputError(path, where, f"JOINT {excerpt(name)} stands in no other joint")
                if name in names:
                    raise InputError(path, where, f"joint {excerpt(name)} stands twice, first on line {names[name]}")
                if len(joints) >= MAX_JOINTS:
                    raise InputError(path, where, f"more than {MAX_JOINTS} joints")
                names[name] = number
                joints.append(BvhJoint(name, stack[-1] if stack else -1, number))
                pending = len(joints) - 1
            elif key in _END:
                if not stack or stack[-1] < 0:
                    raise InputError(path, where, "End Site outside a joint")
                cut = tokens.index("{") if "{" in tokens else len(tokens)
                tokens = tokens[cut:]
                pending = -1
            elif key == "OFFSET":
                cut = tokens.index("}") if "}" in tokens else len(tokens)
                if cut < 3:  # minus signs may stand for blanks
                    tokens = [*numbers_apart(" ".join(tokens[:cut]), 3), *tokens[cut:]]
                offset, tokens = _numbers(path, where, "OFFSET", tokens, 3), tokens[3:]
                if not stack:
                    raise InputError(path, where, "OFFSET outside a joint")
                if stack[-1] >= 0:
                    joints[stack[-1]].offset = offset
                else:
                    joints[stack[-2]].tips.append(offset)
                    tips += 1
                    if tips > _MAX_TIPS:
                        raise InputError(path, where, f"more than {_MAX_TIPS} End Sites")
            elif key == "CHANNELS":
                if not stack or stack[-1] < 0:
                    raise InputError(path, where, "CHANNELS outside a joint")
                count = int(tokens[0]) if tokens and re.fullmatch(r"[0-9]{1,3}", tokens[0]) else -1
                if not 0 <= count <= 6:
                    raise InputError(
                        path, where, f"CHANNELS wants a count of 0 to 6, got {excerpt(''.join(tokens[:1]))}"
                    )
                channels, tokens = tuple(t.lower() for t in tokens[1 : count + 1]), tokens[count + 1 :]
                unknown = [c for c in channels if c not in _CHANNELS]
                if unknown or len(channels) != count:
                    cause = (
                        f"unknown channel {excerpt(unknown[0])}" if unknown else f"{len(channels)} of {count} channels"
                    )
                    raise InputError(path, where, cause)
                positions = [c for c in channels if c.endswith("position")]
                if len(set(positions)) != len(positions) or count - len(positions) > 3:
                    raise InputError(path, where, "a channel stands twice")
                joints[stack[-1]].channels = channels
            else:
                raise InputError(path, where, f"unknown word {excerpt(word)} in the hierarchy: {_EXPECTED}")
    where = f"line {number}"
    if not joints:
        raise InputError(path, where, "no ROOT joint before MOTION")
    if stack or pending is not None:
        raise InputError(path, where, f"{max(len(stack), 1)} brace(s) not closed before MOTION")
    if not any(j.channels for j in joints):
        raise InputError(path, where, "no joint has CHANNELS")
    return joints


def _numbers(path: Path, where: str, label: str, tokens: list[str], count: int) -> tuple[float, float, float]:
    try:
        values = tuple(float(t) for t in tokens[:count])
    except ValueError:
        raise InputError(path, where, f"{label} {excerpt(' '.join(tokens[:count]))} is not {count} numbers") from None
    if len(values) != count:
        raise InputError(path, where, f"{label} wants {count} numbers, got {len(values)}")
    if not all(abs(v) < _MAX_VALUE for v in values):
        raise InputError(path, where, f"{label} {excerpt(' '.join(tokens[:count]))} is not finite or absurdly large")
    return values[0], values[1], values[2]


def _parse_motion(
    path: Path, text: str, start: int, joints: list[BvhJoint], timed: bool, notes: list[str]
) -> tuple[str, Array]:
    n_channels = sum(len(j.channels or ()) for j in joints)
    number = text.count("\n", 0, start) + 1
    fields: dict[str, tuple[str, int]] = {}
    position = start + 1
    while len(fields) < 2 and position < len(text):
        stop = text.find("\n", position)
        stop = len(text) if stop < 0 else stop
        number += 1
        line = text[position : min(stop, position + 200)].strip()
        position = stop + 1
        if not line or line.startswith(_COMMENT):
            continue
        match = _FIELD.fullmatch(line)
        if match is None:
            raise InputError(path, f"line {number}", f"expected 'Frames:' and 'Frame Time:', found {excerpt(line)}")
        fields["frames" if match[1].lower() == "frames" else "frame time"] = (match[3].strip(), number)
    for key in ("frames", "frame time"):
        if key not in fields:
            raise InputError(path, f"line {number}", f"the file ends before '{key.title()}:'")

    value, where = fields["frames"]
    if not re.fullmatch(r"\+?[0-9]{1,18}", value) or int(value) == 0:
        raise InputError(path, f"line {where}", f"Frames must be a positive whole number, got {excerpt(value)}")
    frames = int(value)
    room = len(text) - position
    least = frames - _slip(frames)
    if least * n_channels * 2 > room + 2:  # a number and the blank after it take two bytes at least
        cause = f"{frames} frames of {n_channels} numbers announced, only {max(room, 0)} bytes follow: cut short"
        raise InputError(path, f"line {where}", cause)
    # Every joint becomes a translation in time, channels or not, and the root a pose.
    check_values(path, f"line {where}", frames, n_channels + 3 * len(joints) + 12)
    value, where = fields["frame time"]
    if timed:
        _check_time(path, where, value)
    values = _parse_frames(path, text, position, number + 1, frames, n_channels, notes)
    if len(values) != frames:
        notes.append(f"{frames} frames are announced and {len(values)} are there: those were read")
    return value, values


def _check_time(path: Path, where: int, value: str) -> None:
    way = "the option fps gives the frame rate instead"
    try:
        frame_time = float(value)
    except ValueError:
        raise InputError(path, f"line {where}", f"Frame Time {excerpt(value)} is not a number; {way}") from None
    if not (math.isfinite(frame_time) and 1e-5 <= frame_time <= 10.0):
        raise InputError(path, f"line {where}", f"Frame Time {excerpt(value)} s is not between 1e-5 and 10; {way}")


def _slip(frames: int) -> int:
    """By how many frames the announced number may be wrong: some writers count one too many or too few.

    In a file of a few frames one more or less is damage.
    """
    return 1 if frames >= _LEAST_FOR_A_SLIP else 0


def _parse_frames(
    path: Path, text: str, start: int, first_line: int, frames: int, n_channels: int, notes: list[str]
) -> Array:
    """The motion block ``[frames, n_channels]``; every line that is neither blank nor a comment is a frame."""
    longest, rows, number, position = _MAX_NUMBER_CHARACTERS * n_channels + 1024, 0, first_line, start
    kept: list[str] = []  # pieces of the text, from where the first line had to be changed
    copied, mended = start, 0
    while position < len(text):
        stop = text.find("\n", position)
        stop = len(text) if stop < 0 else stop
        if stop - position > longest:
            cause = f"{stop - position} characters long; {n_channels} numbers do not take as many"
            raise InputError(path, f"line {number}", cause)
        line = text[position:stop]
        count = len(line.split())
        if count and line.lstrip().startswith(_COMMENT):
            kept.append(text[copied:position])
            copied, count = stop, 0
        if count:
            rows += 1
            if rows > frames + _slip(frames):
                cause = f"more than the {frames} frames announced (if they belong to it, correct 'Frames:')"
                raise InputError(path, f"line {number}", cause)
            if count != n_channels:
                words = numbers_apart(line, n_channels)
                if len(words) != n_channels:
                    cause = f"frame {rows} of {frames} has {count} numbers, the hierarchy has {n_channels} channels"
                    raise InputError(path, f"line {number}", cause)
                kept += [text[copied:position], " ".join(words)]
                copied, mended = stop, mended + 1
        position, number = stop + 1, number + 1
    if rows < frames - _slip(frames):
        cause = f"{frames} frames announced, the file ends after {rows}: cut short (if not, correct 'Frames:')"
        raise InputError(path, f"line {number - 1}", cause)
    if mended:
        notes.append(f"{mended} lines hold numbers without a blank between them: they were told apart")
    text, start, first_line = ("".join([*kept, text[copied:]]), 0, first_line) if kept else (text, start, first_line)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # NumPy's way of saying it stopped at a word
        try:
            values = np.fromstring(text[start:], sep=" ")
        except ValueError:
            values = np.empty(0)
    if values.size != rows * n_channels or not (np.abs(values) < _MAX_VALUE).all():
        _blame(path, text, start, first_line)
    return values.reshape(rows, n_channels)


def _blame(path: Path, text: str, start: int, first_line: int) -> None:
    """Raise on the first number that is none; only called when there is one."""
    for number, line in enumerate(text[start:].split("\n"), first_line):
        for word in line.split():
            try:
                value = float(word)
            except ValueError:
                raise InputError(path, f"line {number}", f"{excerpt(word)} is not a number") from None
            if not abs(value) < _MAX_VALUE:
                raise InputError(path, f"line {number}", f"{excerpt(word)} is not finite or absurdly large")
    raise InputError(path, f"line {first_line}", "the motion block holds something that is not a number")
