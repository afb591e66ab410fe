"""Which point of a marker file stands for which place of the body.

Names of Pose2Sim and OpenPose (``RHip``, ``LBigToe``), MediaPipe and FreeMoCap (``left_hip``), joint centres of
OpenSim, OpenCap and Vicon's models (``hip_r``, ``RHJC_study``) and of animation rigs (``LeftUpLeg``), the project's own
among them. Markers on the skin have to be named by hand: nothing says how far they lie from the joint.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from egopose.core.errors import InputError
from egopose.motion.mapping import SIDES

#: Part on either side -> words for it, the best first. A word that a better one of another part has taken is passed
#: over: beside ``LeftArm`` a ``LeftShoulder`` is the collar bone.
_SIDED = {
    "hip": "hjc upleg upperleg thigh femur hip",
    "knee": "kjc knee lowerleg lowleg leg shin calf tibia shank",
    "ankle": "ajc ankle foot",
    "shoulder": "sjc upperarm uparm arm humerus gh glenohumeral shoulder shoulderjoint",
    "elbow": "ejc elbow forearm lowerarm lowarm radius ulna",
    "wrist": "wjc wrist hand",
    "toe": "bigtoe footindex toe toes toebase ball mtp foottip",
    "small_toe": "smalltoe littletoe smalltoes",
    "heel": "heel calcn calcaneus",
    "hand_tip": "handtip handend middle middlefinger fingertip",
    "index": "index handindex index1 indexfinger",
    "pinky": "pinky handpinky pinky1 pinkyfinger smallfinger",
    "ear": "ear",
    "eye": "eye",
}
_MIDDLE = {
    "neck": "neck neckcenter neckcentre necktop c7 cervicale",
    "head": "head headcenter headcentre skull",
    "crown": "headtip headtop topofhead htop vertex headend headsite",
    "nose": "nose",
}
#: Words that programs add and that say nothing of the place.
_NOISE = frozenset(
    [
        "mixamorig",
        "cc",
        "base",
        "b",
        "bip",
        "bip01",
        "jnt",
        "joint",
        "jc",
        "centre",
        "center",
        "marker",
        "study",
        "augmenter",
    ]
)

#: The project's own name for a foot's end; a sole with corners has several, numbered from the second on.
_SOLE = "foottip"

_PARTS = (*(f"{side}_{part}" for side in SIDES for part in _SIDED), *_MIDDLE)
#: Letters of names in an error.
_SHOWN = 180
_NEEDED = tuple(f"{side}_{part}" for side in SIDES for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist"))


def find_parts(
    path: Path, names: Sequence[str], given: Mapping[str, str | Sequence[str]] | None = None
) -> dict[str, list[int]]:
    """Part of the body -> columns of the points whose mean stands for it.

    Args:
        path: of the file, for errors.
        names: of its points.
        given: part -> name or names, where the names do not say it themselves.

    Raises:
        InputError: a part that is needed has no point, ``given`` names what is not there; the names found are listed.
    """
    parts = _given(path, names, given or {})
    words = [_words(name) for name in _without_common_start(names)]
    taken = {column for columns in parts.values() for column in columns}
    for side in (*SIDES, ""):
        for part, aliases in (_SIDED if side else _MIDDLE).items():
            key = f"{side}_{part}" if side else part
            if key in parts:
                continue
            for alias in aliases.split():
                hits = [k for k, word in enumerate(words) if word == (side, alias) and k not in taken]
                if alias == _SOLE:
                    hits += [k for k, (s, w) in enumerate(words) if s == side and re.fullmatch(rf"{_SOLE}\d+", w)]
                if hits:
                    parts[key] = hits if alias == _SOLE else hits[:1]
                    taken.update(parts[key])
                    break
    missing = [part for part in _NEEDED if part not in parts]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        cause = (
            f"no point is known as {', '.join(missing[:3])}{more}; say points={{{missing[0]}: NAME}}, or [NAME, NAME] "
            f"for the middle of two; the file has: {_excerpt(names)}"
        )
        raise InputError(path, "points", cause)
    return parts


def _excerpt(names: Sequence[str]) -> str:
    """Names fit for the end of an error's line."""
    shown = " ".join(", ".join(names).split())
    return (shown if len(shown) <= _SHOWN else shown[:_SHOWN] + " ...") or "none"


def _given(path: Path, names: Sequence[str], given: Mapping[str, str | Sequence[str]]) -> dict[str, list[int]]:
    if not isinstance(given, Mapping):
        raise InputError(path, "option points", "must map parts of the body to names of points")
    parts = {}
    for part, value in given.items():
        if part not in _PARTS:
            cause = f"is no part; there are {', '.join(_MIDDLE)} and right_ or left_ {', '.join(_SIDED)}"
            raise InputError(path, f"option points.{str(part)[:40]}", cause)
        wanted = [value] if isinstance(value, str) else list(value)
        absent = [str(name) for name in wanted if name not in names]
        if absent or not wanted:
            cause = f"there is no point {', '.join(absent)[:80] or 'in an empty list'}; the file has: "
            raise InputError(path, f"option points.{part}", cause + _excerpt(names))
        parts[part] = [list(names).index(name) for name in wanted]
    return parts


def _without_common_start(names: Sequence[str]) -> list[str]:
    """Names without what stands before a ``:``, and without a word that all of them begin with."""
    short = [name.rpartition(":")[2] for name in names]
    first, last = min(short), max(short)
    alike = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    cut = max(first.rfind("_", 0, alike), first.rfind(" ", 0, alike)) + 1
    return [name[cut:] for name in short]


def _words(name: str) -> tuple[str, str]:
    """Side (``""`` in the middle) and the name's own word in small letters: ``RBigToe`` is ``("right", "bigtoe")``."""
    tokens = [t.lower() for t in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]
    tokens = [t for t in tokens if t not in _NOISE]
    side = ""
    for mark, which in (("left", "left"), ("right", "right"), ("l", "left"), ("r", "right")):
        if mark in tokens:
            side = which
            tokens.remove(mark)
            break
    word = re.sub("^ankletip", _SOLE, "".join(tokens))
    if not side:
        for mark, which in (("left", "left"), ("right", "right"), ("l", "left"), ("r", "right")):
            if word.startswith(mark) and word[len(mark) :] in _WORDS:
                return which, word[len(mark) :]
    return side, word


_WORDS = frozenset(word for aliases in _SIDED.values() for word in aliases.split())
