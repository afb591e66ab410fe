"""Which keypoints a pose has: names, limbs to draw, the other side of each, and the humanoid's joint they stand for.

Layouts differ between pose networks; names do not. A layout is turned into another one by name, and the middle of two
keypoints stands in for one that a network does not give (the neck is the middle of the shoulders, as OpenPose has it).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from egopose.motion.rotations import Array


@dataclass(frozen=True)
class KeypointSchema:
    """A layout of ``K`` keypoints.

    Args:
        name: of the layout.
        names: of its keypoints, in order; either side's begin with ``left_`` or ``right_``.
    """

    name: str
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Row of a keypoint. Raises KeyError naming the layout."""
        if name not in self.names:
            raise KeyError(f"{self.name} has no keypoint {name!r}")
        return self.names.index(name)

    @cached_property
    def mirror(self) -> np.ndarray:
        """``[K]`` row of each keypoint's twin on the other side; its own row in the middle of the body."""
        return np.array([self.names.index(other_side(name)) for name in self.names])

    @cached_property
    def limbs(self) -> tuple[tuple[int, int], ...]:
        """Pairs of rows that a bone joins."""
        there = set(self.names)
        return tuple((self.index(a), self.index(b)) for a, b in _LIMBS if {a, b} <= there)


def other_side(name: str) -> str:
    """``left_knee`` of ``right_knee``; a name of the middle stays."""
    if name.startswith("left_"):
        return "right_" + name[5:]
    return "left_" + name[6:] if name.startswith("right_") else name


def _sided(*parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts for side in ("left", "right"))


_ARM, _LEG, _FOOT = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"), ("big_toe", "small_toe", "heel")

#: OpenPose's (v1.3 and later): the layout that all readers and estimators are turned into.
BODY_25 = KeypointSchema(
    "BODY_25",
    (
        *("nose", "neck"),
        *(f"{side}_{part}" for side in ("right", "left") for part in _ARM),
        "mid_hip",
        *(f"{side}_{part}" for side in ("right", "left") for part in _LEG),
        *("right_eye", "left_eye", "right_ear", "left_ear"),
        *(f"{side}_{part}" for side in ("left", "right") for part in _FOOT),
    ),
)

#: OpenPose's older layout of COCO's keypoints and a neck.
COCO_18 = KeypointSchema(
    "COCO_18",
    (
        *("nose", "neck"),
        *(f"{side}_{part}" for side in ("right", "left") for part in _ARM),
        *(f"{side}_{part}" for side in ("right", "left") for part in _LEG),
        *("right_eye", "left_eye", "right_ear", "left_ear"),
    ),
)

#: MediaPipe's. Its foot index lies at the tip of the second toe, in front of OpenPose's big toe.
BLAZEPOSE_33 = KeypointSchema(
    "BLAZEPOSE_33",
    (
        *("nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer"),
        *_sided("ear"),
        *("left_mouth", "right_mouth"),
        *_sided(*_ARM, "pinky", "index", "thumb", *_LEG, "heel", "foot_index"),
    ),
)

SCHEMAS = {schema.name: schema for schema in (BODY_25, COCO_18, BLAZEPOSE_33)}

#: What stands in for a keypoint that a layout lacks: the mean of these.
STAND_INS = {
    "neck": ("left_shoulder", "right_shoulder"),
    "mid_hip": ("left_hip", "right_hip"),
    "left_big_toe": ("left_foot_index",),
    "right_big_toe": ("right_foot_index",),
}

_LIMBS = (
    *(("mid_hip", "neck"), ("neck", "nose")),
    *(pair for s in ("left", "right") for pair in ((f"{s}_shoulder", f"{s}_elbow"), (f"{s}_elbow", f"{s}_wrist"))),
    *(pair for s in ("left", "right") for pair in (("neck", f"{s}_shoulder"), ("mid_hip", f"{s}_hip"))),
    *(pair for s in ("left", "right") for pair in ((f"{s}_hip", f"{s}_knee"), (f"{s}_knee", f"{s}_ankle"))),
    *(pair for s in ("left", "right") for pair in ((f"{s}_ankle", f"{s}_heel"), (f"{s}_ankle", f"{s}_big_toe"))),
    *((f"{s}_ankle", f"{s}_foot_index") for s in ("left", "right")),
    *((f"{s}_shoulder", f"{s}_hip") for s in ("left", "right")),
    *(("left_shoulder", "right_shoulder"), ("left_hip", "right_hip")),
)

#: Keypoint -> joint of the humanoid that lies there. Neck and middle of the hips follow from two each.
HUMANOID_JOINTS = {
    f"{side.lower()}_{part}": f"{side}{joint}"
    for side in ("Left", "Right")
    for part, joint in (
        *(("shoulder", "Arm"), ("elbow", "ForeArm"), ("wrist", "Hand")),
        *(("hip", "UpLeg"), ("knee", "Leg"), ("ankle", "Foot")),
    )
}


def converted(values: Array, confidence: Array, source: KeypointSchema, target: KeypointSchema) -> tuple[Array, Array]:
    """Keypoints of one layout in another one's order.

    Args:
        values: ``[T, K, d]``, pixels or metres; NaN where unknown.
        confidence: ``[T, K]``.
        source, target: their layouts.

    Returns:
        Values ``[T, K', d]`` (NaN where the source has no such keypoint) and confidence ``[T, K']`` (0 there). A mean
        of two is as sure as the less sure one.
    """
    out = np.full((len(values), len(target), values.shape[-1]), np.nan)
    sure = np.zeros((len(values), len(target)))
    for row, name in enumerate(target.names):
        parts = (name,) if name in source.names else STAND_INS.get(name, ())
        if not parts or not set(parts) <= set(source.names):
            continue
        rows = [source.index(part) for part in parts]
        out[:, row] = values[:, rows].mean(axis=1)
        sure[:, row] = confidence[:, rows].min(axis=1)
    return out, sure
