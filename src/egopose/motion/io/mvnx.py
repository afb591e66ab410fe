"""MVNX, the XML of Xsens MVN (versions 3 and 4): every segment's position and orientation, frame by frame.

Xsens MVN User Manual, "MVNX": z up, metres, quaternions ``wxyz`` from the segment's frame to the world. In the T-pose
all segments' frames are the world's: x forward, y left, z up. Frames of the types ``identity``, ``tpose``,
``tpose-isb`` and ``npose`` stand before the motion and hold calibration poses.

The file is read as a stream by Expat, Python's own XML parser. Any ``<!DOCTYPE`` is refused where it begins, so no
entity is ever declared, let alone expanded: this is what ``defusedxml`` does, and that has no streaming parser.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from egopose.core.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.io._files import MAX_JOINTS, excerpt
from egopose.motion.io.segments import ARM_AXES, ELBOW_AXES, LEG_AXES, TRUNK_AXES, Segment, Vector, skeleton_of
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: The largest file read, bytes: twenty minutes at 60 frames/s with every field that MVN can export.
MAX_BYTES = 2**30
_CHUNK = 2**20

#: The most numbers of one person that are read: an hour at 60 frames/s.
_MAX_NUMBERS = 2**25

#: Bytes of one tag or comment, which Expat holds until its end comes.
_MAX_TOKEN = 2**23

#: Letters of one element's text: 2048 quaternions take less.
_MAX_TEXT = 2**18

#: No frame of MVN's nests deeper than seven elements.
_MAX_DEPTH = 32

#: Segment -> parent, hinges' axes, and the point of its own that ends it.
_TREE: dict[str, tuple[str, str, str]] = {
    "Pelvis": ("", TRUNK_AXES, ""),
    "L5": ("Pelvis", TRUNK_AXES, ""),
    "L3": ("L5", TRUNK_AXES, ""),
    "T12": ("L3", TRUNK_AXES, ""),
    "T8": ("T12", TRUNK_AXES, ""),
    "Neck": ("T8", TRUNK_AXES, ""),
    "Head": ("Neck", TRUNK_AXES, "pTopOfHead"),
}
for _side in ("Right", "Left"):
    _TREE |= {
        f"{_side}Shoulder": ("T8", ARM_AXES, ""),
        f"{_side}UpperArm": (f"{_side}Shoulder", ARM_AXES, ""),
        f"{_side}ForeArm": (f"{_side}UpperArm", ELBOW_AXES, ""),
        f"{_side}Hand": (f"{_side}ForeArm", ARM_AXES, f"p{_side}TopOfHand"),
        f"{_side}UpperLeg": ("Pelvis", LEG_AXES, ""),
        f"{_side}LowerLeg": (f"{_side}UpperLeg", LEG_AXES, ""),
        f"{_side}Foot": (f"{_side}LowerLeg", LEG_AXES, ""),
        f"{_side}Toe": (f"{_side}Foot", LEG_AXES, f"p{_side}Toe"),
    }
#: Constant bones fit MVN's joints to a fraction of a millimetre; more than this (m) is worth saying.
_LOOSE = 0.01
_CALIBRATION = ("identity", "tpose", "tpose-isb", "npose")


@dataclass
class _Subject:
    """What one ``<subject>`` holds; ``frames`` are (positions, orientations) as the file has them."""

    label: str
    rate: str
    segments: list[str] = field(default_factory=list)
    points: dict[str, Vector] = field(default_factory=dict)
    position: list[Array] = field(default_factory=list)
    orientation: list[Array] = field(default_factory=list)
    tpose: Array | None = None
    skipped: dict[str, int] = field(default_factory=dict)


def read_mvnx(path: str | Path, *, subject: str | None = None) -> Motion:
    """Read an MVNX file.

    Args:
        path: the file; segments' positions and orientations must have been exported.
        subject: label of the person, where the file holds more than one.

    Returns:
        The motion's own frames: calibration poses are left out and counted in ``meta["calibration_frames"]``.
        ``meta["fit_mm"]`` is how far, on average, the joints of constant bones lie from the file's.

    Raises:
        InputError: not XML, a DOCTYPE, over :data:`MAX_BYTES`, no ``Pelvis``, no positions or orientations, frames
            whose numbers do not fit the segments, numbers that are not finite, no motion frame, no frame rate.
    """
    path = Path(path)
    subjects = _Parser(path).run()
    chosen = _choose(path, subjects, subject)
    rate = _rate(path, chosen)
    known = [(i, name) for i, name in enumerate(chosen.segments) if name in _TREE]
    if "Pelvis" not in chosen.segments:
        raise InputError(path, "segments", f"there is no Pelvis; found {', '.join(chosen.segments)[:120] or 'none'}")
    if not chosen.orientation:
        raise InputError(path, "frames", "no frame of type normal: the file holds calibration poses only")
    columns = {name: i for i, name in known}
    names = [name for name in _TREE if name in columns]
    pick = [columns[name] for name in names]
    positions = np.stack(chosen.position)[:, pick].astype(np.float64)
    quats = rot.normalize(np.stack(chosen.orientation)[:, pick].astype(np.float64))
    # The T-pose becomes the zero pose, whatever frames the segments had in it.
    tpose = np.tile([1.0, 0.0, 0.0, 0.0], (len(pick), 1)) if chosen.tpose is None else rot.normalize(chosen.tpose[pick])
    quats = rot.multiply(quats, rot.conjugate(tpose)[None])
    segments = [_segment(name, names, chosen.points, turn) for name, turn in zip(names, tpose, strict=True)]
    skeleton, qpos, left = skeleton_of(segments, positions, quats, "xsens")
    notes = []
    dropped = [name for name in chosen.segments if name not in _TREE]
    if dropped:
        notes.append(f"segments of no body were left out: {', '.join(dropped)[:200]}")
    if left > _LOOSE:
        notes.append(f"joints lie {1000 * left:.0f} mm from the file's on average: its bones do not keep their lengths")
    meta = {
        "format": "mvnx",
        "source": path.name,
        "unit": "m",
        "unit_metres": 1.0,
        "up": "z",
        "subject": chosen.label,
        "calibration_frames": chosen.skipped,
        "fit_mm": round(1000 * left, 3),
        "notes": notes,
    }
    return Motion(skeleton, qpos, rate, name=path.stem, meta=meta)


def _segment(name: str, present: list[str], points: dict[str, Vector], turn: Array) -> Segment:
    """Parents that the file lacks (a capture of the lower body) are stepped over; ``turn [4]`` is the T-pose's."""
    parent, axes, end = _TREE[name]
    while parent and parent not in present:
        parent = _TREE[parent][0]
    if end not in points:
        return Segment(name, parent, axes)
    x, y, z = rot.rotate(turn, np.array(points[end])).tolist()
    return Segment(name, parent, axes, ((x, y, z),))


def _choose(path: Path, subjects: list[_Subject], label: str | None) -> _Subject:
    labels = ", ".join(s.label for s in subjects)[:200]
    if label is not None:
        for candidate in subjects:
            if candidate.label == label:
                return candidate
        raise InputError(path, "option subject", f"there is no {excerpt(label)}; the file has {labels or 'none'}")
    if not subjects:
        raise InputError(path, "subject", "there is none: not an MVNX file")
    if len(subjects) > 1:
        raise InputError(path, "subject", f"{len(subjects)} people: say which with subject=NAME out of {labels}")
    return subjects[0]


def _rate(path: Path, subject: _Subject) -> float:
    try:
        rate = float(subject.rate)
    except ValueError:
        rate = 0.0
    if not 1.0 <= rate <= 1e4:
        raise InputError(path, "frameRate", f"{excerpt(subject.rate)} is not a frame rate")
    return rate


class _Parser:
    """Walks through the file once and keeps only what a motion needs."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._subjects: list[_Subject] = []
        self._open: list[str] = []
        self._text: list[str] | None = None
        self._letters = 0
        self._point, self._kind = "", ""
        self._frame: dict[str, Array] = {}
        self._parser = expat.ParserCreate(namespace_separator=" ")
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._characters
        self._parser.StartDoctypeDeclHandler = self._doctype
        self._parser.buffer_text = True

    def run(self) -> list[_Subject]:
        path = self._path
        if not path.is_file():
            raise InputError(path, "path", "is a folder or a device" if path.exists() else "no such file")
        size = path.stat().st_size
        if not size:
            raise InputError(path, "size", "the file is empty")
        if size > MAX_BYTES:
            raise InputError(path, "size", f"{size} bytes; at most {MAX_BYTES} are read: cut the motion into parts")
        try:
            read = 0
            with path.open("rb") as stream:
                while chunk := stream.read(_CHUNK):
                    self._parser.Parse(chunk, False)
                    read += len(chunk)
                    if read - self._parser.CurrentByteIndex > _MAX_TOKEN:
                        raise InputError(path, self._line(), f"a tag or comment of over {_MAX_TOKEN} bytes")
                self._parser.Parse(b"", True)
        except expat.ExpatError as error:
            raise InputError(path, f"line {error.lineno}", f"not XML: {expat.errors.messages[error.code]}") from error
        except (LookupError, UnicodeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(path, self._line(), f"not XML: {error}"[:160]) from error
        except OSError as error:
            raise InputError(path, "path", f"cannot be read: {error.strerror}") from error
        return self._subjects

    def _line(self) -> str:
        return f"line {self._parser.CurrentLineNumber}"

    def _doctype(self, *_: Any) -> None:
        raise InputError(self._path, self._line(), "a DOCTYPE, which no MVNX file has: refused, as it may name others")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        tag = name.rpartition(" ")[2]
        self._open.append(tag)
        if len(self._open) > _MAX_DEPTH:
            raise InputError(self._path, self._line(), f"elements nested more than {_MAX_DEPTH} deep")
        if len(self._open) == 1 and tag != "mvnx":
            raise InputError(self._path, self._line(), f"begins with <{tag[:40]}>, not with <mvnx>")
        if tag == "subject":
            if len(self._subjects) >= MAX_JOINTS:
                raise InputError(self._path, self._line(), f"more than {MAX_JOINTS} subjects")
            rate = attributes.get("frameRate", "")
            self._subjects.append(_Subject(attributes.get("label", f"{len(self._subjects) + 1}")[:80], rate))
        if not self._subjects:
            return
        subject, above = self._subjects[-1], self._open[-2]
        if tag == "segment" and above == "segments":
            if len(subject.segments) >= MAX_JOINTS:
                raise InputError(self._path, self._line(), f"more than {MAX_JOINTS} segments")
            label = attributes.get("label", "")[:80]
            if label in subject.segments:
                raise InputError(self._path, self._line(), f"segment {excerpt(label)} stands twice")
            subject.segments.append(label)
        elif tag == "point":
            self._point = attributes.get("label", "")[:80]
        elif tag == "frame" and above == "frames":
            self._kind, self._frame = attributes.get("type", "normal").lower(), {}
        elif (tag in ("position", "orientation") and above == "frame") or tag in ("pos_b", "pos_s"):
            self._text, self._letters = [], 0

    def _characters(self, text: str) -> None:
        if self._text is None:
            return
        self._letters += len(text)
        if self._letters > _MAX_TEXT:
            raise InputError(self._path, self._line(), f"more than {_MAX_TEXT} letters of numbers in one element")
        self._text.append(text)

    def _end(self, name: str) -> None:
        tag = self._open.pop()
        if not self._subjects:
            return
        subject = self._subjects[-1]
        if self._text is not None and tag in ("position", "orientation"):
            width = 3 if tag == "position" else 4
            self._frame[tag] = self._numbers(tag, len(subject.segments) * width).reshape(-1, width)
            self._text = None
        elif self._text is not None and tag in ("pos_b", "pos_s"):
            x, y, z = self._numbers(tag, 3).tolist()
            if len(subject.points) < MAX_JOINTS:
                subject.points[self._point] = (x, y, z)
            self._text = None
        elif tag == "frame" and self._open[-1:] == ["frames"]:
            self._close_frame(subject)

    def _numbers(self, tag: str, count: int) -> Array:
        words = "".join(self._text or ()).split()
        if len(words) != count:
            raise InputError(self._path, self._line(), f"<{tag}> has {len(words)} numbers, {count} are wanted")
        try:
            values = np.array(words, dtype=np.float64)
        except ValueError:
            raise InputError(self._path, self._line(), f"<{tag}>: not all of it is numbers") from None
        if not (np.abs(values) < 1e4).all():
            raise InputError(self._path, self._line(), f"<{tag}>: a number is not finite or absurdly large")
        return values

    def _close_frame(self, subject: _Subject) -> None:
        if self._kind in _CALIBRATION:
            subject.skipped[self._kind] = subject.skipped.get(self._kind, 0) + 1
            if self._kind == "tpose" and "orientation" in self._frame:
                subject.tpose = self._checked(self._frame["orientation"])
            return
        if self._kind != "normal":
            raise InputError(self._path, self._line(), f"a frame of the unknown type {excerpt(self._kind)}")
        for part in ("position", "orientation"):
            if part not in self._frame:
                cause = f"the frame has no <{part}>: export segments' positions and orientations from MVN"
                raise InputError(self._path, self._line(), cause)
        subject.position.append(self._frame["position"].astype(np.float32))
        subject.orientation.append(self._checked(self._frame["orientation"]).astype(np.float32))
        if len(subject.position) * 7 * len(subject.segments) > _MAX_NUMBERS:
            cause = f"more than {_MAX_NUMBERS} numbers; cut the motion into parts"
            raise InputError(self._path, self._line(), cause)

    def _checked(self, quats: Array) -> Array:
        lengths = np.linalg.norm(quats, axis=1)
        if len(lengths) and not (lengths.min() > 0.9 and lengths.max() < 1.1):
            raise InputError(self._path, self._line(), "<orientation>: a quaternion whose length is far from 1")
        return quats
