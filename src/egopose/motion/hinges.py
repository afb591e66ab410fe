"""The axis a knee or elbow turns about, in the frames of the two bones beside it.

A limb that bends far shows its axis and which way it bends. One that hardly bends, or bends a little the wrong way (a
hyperextended knee), does not: then anatomy says it: the other side's limb, the toes, and how the limb hangs in the
body's stance. Taking the bend's own sign there once turned standing legs by 180 degrees.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.calibration import Stance, bone_direction
from egopose.motion.rotations import Array

#: A bend beyond this is no hyperextension, rad: 20 degrees (a lax knee reaches 15).
_FAR = np.deg2rad(20.0)
#: Root mean square sine of the bend below which the bones' plane is noise.
_NOISE = 0.05
#: Cosine of the angle to the anatomical axis below which that axis does not tell the bend's sign.
_UNSURE = 0.35


@dataclass(frozen=True)
class Limb:
    """One limb of the source and of the model.

    Args:
        parts: its two bones, ``("left_thigh", "left_shin")``.
        joints: the source joints whose frames the bones are constant in.
        quats: ``[2, T, 4]`` these joints' orientations.
        bones: ``[2, T, 3]`` world vectors of the bones.
        rest: ``[2, 3]`` the bones in the model's rest pose.
        hinge: ``[3]`` the model's axis in its rest pose.
        toe: ``[T, 3]`` world vector from ankle to toe, or None.
    """

    parts: tuple[str, str]
    joints: tuple[int, int]
    quats: Array
    bones: Array
    rest: Array
    hinge: Array
    toe: Array | None = None


def hinge_axes(limbs: Iterable[Limb], stance: Stance) -> dict[str, Array]:
    """Part -> unit axis ``[3]`` in its source joint's frame, for both bones of every limb; right and left together."""
    limbs = list(limbs)
    seen = {limb.parts: _seen_axes(limb) for limb in limbs}
    out: dict[str, Array] = {}
    for limb in limbs:
        axes = seen[limb.parts]
        if axes is None:
            mirror = tuple(_other(part) for part in limb.parts)
            other = next((o for o in limbs if o.parts == mirror and seen[o.parts] is not None), None)
            axes = _anatomical_axes(limb, other, None if other is None else seen[other.parts], stance)
        out |= dict(zip(limb.parts, axes, strict=True))
    return out


def _other(part: str) -> str:
    return part.replace("left", "right") if part.startswith("left") else part.replace("right", "left")


def _normals(limb: Limb) -> tuple[Array, Array]:
    """``[T, 3]`` the bones' common normal, as long as the bend's sine; and the bend ``[T]``, rad."""
    upper, lower = (bone / np.maximum(np.linalg.norm(bone, axis=1, keepdims=True), 1e-9) for bone in limb.bones)
    normal = np.cross(upper, lower)
    return normal, np.arctan2(np.linalg.norm(normal, axis=1), np.sum(upper * lower, axis=1))


def _seen_axes(limb: Limb) -> Array | None:
    """``[2, 3]`` axes of a limb that bends far in some frames; None where it never does."""
    normal, bend = _normals(limb)
    far = bend > _FAR
    if far.sum() < min(3, len(bend)):
        return None
    axes = []
    for quats in limb.quats:
        local = rot.rotate(rot.conjugate(quats), normal)
        sign = np.where(local @ local[far].mean(axis=0) < 0, -1.0, 1.0)
        axes.append(_unit((local * sign[:, None]).mean(axis=0)))
    return np.stack(axes)


def _anatomical_axes(limb: Limb, other: Limb | None, other_axes: Array | None, stance: Stance) -> Array:
    """``[2, 3]`` axes of a limb that never bends far: the plane of its bones if that is seen, signed by anatomy."""
    normal, _ = _normals(limb)
    axes = []
    for k, (quats, joint) in enumerate(zip(limb.quats, limb.joints, strict=True)):
        to_frame = rot.conjugate(stance.orientations[joint])
        if other is not None and other_axes is not None:
            x, y, z = rot.rotate(stance.orientations[other.joints[k]], other_axes[k])
            expected = rot.rotate(to_frame, np.array([-x, y, -z]))  # a turn seen in the mirror of left and right
        else:
            hangs = rot.rotate(stance.orientations[joint], bone_direction(quats, limb.bones[k]))
            expected = rot.rotate(to_frame, rot.rotate(rot.between(limb.rest[k], hangs), limb.hinge))
            if limb.toe is not None:
                # The shin swings away from the toes. Feet turned out by less than a quarter turn keep the sign.
                toe = np.cross(_unit(limb.toe), _unit(limb.bones[1]))
                toes = rot.rotate(rot.conjugate(quats), toe).mean(axis=0)
                if np.dot(expected, toes) < -0.3:
                    expected = _unit(toes)
        local = rot.rotate(rot.conjugate(quats), normal)
        seen, strength = _principal(local)
        agree = float(np.dot(seen, expected))
        if strength < _NOISE:
            axes.append(expected)
        elif abs(agree) > _UNSURE:
            axes.append(seen * np.sign(agree))
        else:
            # The arm is turned a quarter from where it was expected: only the bend is left to say which way.
            axes.append(seen * (1.0 if np.sum(local @ seen) >= 0 else -1.0))
    return np.stack(axes)


def _principal(vectors: Array) -> tuple[Array, float]:
    """The unit axis ``[3]`` that ``[T, 3]`` vectors lie along, either way, and their root mean square along it."""
    values, axes = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    return axes[:, -1], float(np.sqrt(max(values[-1], 0.0)))


def _unit(vector: Array) -> Array:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)
