"""A motion of any humanoid skeleton onto the model's, with a report of the error it makes.

1. :mod:`egopose.motion.calibration` finds how each source joint's frame lies in the model's.
2. Joint orientations carry over; hinges are read off them.
3. Inverse kinematics on the joint positions, bone by bone scaled to the model's lengths, takes out what the model's
   fewer degrees of freedom (one at knee and elbow) leave over.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.calibration import (
    Stance,
    align,
    bone_direction,
    mean_rotation,
    neutral_stance,
    part_positions,
    uprightness,
)
from egopose.motion.feet import Foot, foot_constants
from egopose.motion.hinges import Limb, hinge_axes
from egopose.motion.inverse_kinematics import solve_in_time
from egopose.motion.joint_angles import read_angles
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.mapping import SIDES, BodyMap, identify, sample
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.scaling import MODEL_PARTS, MODEL_SPINE, ik_targets, model_points, scaled_positions
from egopose.motion.skeleton import Skeleton

#: Legs of an adult from hip to ankle, m: heights and speeds that tell a standing foot are for such a one.
_ADULT_LEGS = 0.85


@dataclass(frozen=True)
class RetargetReport:
    """How far the retargeted motion is from its source.

    Args:
        position_mm: part -> mean and largest distance to the scaled source position, millimetres.
        orientation_deg: part -> mean and largest angle to the source's orientation, degrees.
        at_limit: hinge name -> share of frames at a joint limit (only where it is not zero).
        unmapped: source bones that were dropped.
        scale: model leg length / source leg length.
        ground_shift_m: vertical shift that put the soles on the floor (mean, smallest, largest over the frames).
        worst_frame: part -> the frame of its largest distance.
        warnings: what is odd about the clip, see :mod:`egopose.motion.plausibility`.
    """

    position_mm: dict[str, tuple[float, float]]
    orientation_deg: dict[str, tuple[float, float]]
    at_limit: dict[str, float]
    unmapped: tuple[str, ...]
    scale: float
    ground_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    worst_frame: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def table(self) -> str:
        """The report as text, worst joints first."""
        lines = [f"scale {self.scale:.3f}; ground shift {self.ground_shift_m[0] * 100:.1f} cm"]
        lines.append(f"{'part':<16}{'mean mm':>9}{'max mm':>9}{'mean deg':>10}{'max deg':>9}")
        for part in sorted(
            set(self.position_mm) | set(self.orientation_deg), key=lambda p: -self.position_mm.get(p, (0, 0))[0]
        ):
            mm, deg = self.position_mm.get(part, (np.nan, np.nan)), self.orientation_deg.get(part, (np.nan, np.nan))
            lines.append(f"{part:<16}{mm[0]:>9.1f}{mm[1]:>9.1f}{deg[0]:>10.1f}{deg[1]:>9.1f}")
        if self.at_limit:
            lines.append("at a limit: " + ", ".join(f"{k} {v:.0%}" for k, v in self.at_limit.items()))
        lines.append("dropped bones: " + (", ".join(self.unmapped) or "none"))
        lines += [f"warning: {line}" for line in self.warnings]
        return "\n".join(lines)


def retarget(
    motion: Motion, model: Skeleton, limits: Array, overrides: dict[str, str] | None = None
) -> tuple[Motion, RetargetReport]:
    """Put ``motion`` onto the model's skeleton.

    Args:
        motion: of any humanoid skeleton, z up, metres.
        model: the humanoid's skeleton (default: 21 joints, 58 degrees of freedom).
        limits: ``[D, 2]`` rad of the model's hinges.
        overrides: part -> source joint name, where names do not say it.

    Returns:
        The motion on ``model`` at the same frame rate (not yet on the ground: see :mod:`egopose.motion.ground`), and
        the report.

    Raises:
        InputError: the skeleton is not recognised as a humanoid.
    """
    positions, quats = motion.forward_kinematics()
    body_map = identify(motion.skeleton, overrides, sample(positions))
    points = part_positions(body_map, positions, quats, motion.skeleton)
    model_rest = {part: p[0] for part, p in model_points(model, model.rest_qpos()[None]).items()}
    stance = neutral_stance(motion, body_map, quats, points)
    orientations = _orientations(motion, body_map, model, model_rest, quats, points, stance)
    start = read_angles(model, orientations, limits)
    scaled, scale = scaled_positions(points, stance.points, orientations, model_rest)
    start[:, :3] = scaled["hips"]
    targets = ik_targets(model, scaled, orientations)
    qpos = solve_in_time(model, start, targets, limits)
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    out = Motion(model, qpos, motion.fps, motion.name, meta=dict(motion.meta))
    return out, _report(model, qpos, scaled, orientations, limits, body_map, scale)


def _orientations(
    motion: Motion,
    body_map: BodyMap,
    model: Skeleton,
    model_rest: dict[str, Array],
    quats: Array,
    points: dict[str, Array],
    stance: Stance,
) -> dict[str, Array]:
    """World quaternions ``[T, 4]`` for the model's joints, carried over from the source's."""
    parts, out = body_map.parts, {}

    def carried(joint: int, constant: Array | None = None) -> Array:
        to_model = rot.conjugate(stance.orientations[joint]) if constant is None else constant
        return rot.multiply(quats[:, joint], to_model[None])

    for part in ("hips", "neck", "head", "left_clavicle", "right_clavicle"):
        if part in parts:
            out[MODEL_PARTS[part]] = carried(parts[part])
    limbs = [_limb(model, model_rest, body_map, quats, points, s, p) for s in SIDES for p in _LIMBS]
    axes = hinge_axes(limbs, stance)
    for limb in limbs:
        for k, (part, joint) in enumerate(zip(limb.parts, limb.joints, strict=True)):
            along = bone_direction(limb.quats[k], limb.bones[k])
            out[MODEL_PARTS[part]] = carried(joint, align((along, axes[part]), (limb.rest[k], limb.hinge)))
    feet = {s: _foot(model, model_rest, parts, quats, points, out, s) for s in SIDES if f"{s}_toe" in points}
    size = _leg_length(points) / _ADULT_LEGS
    constants = foot_constants(feet, stance, uprightness(points), size, motion.fps)
    for side in SIDES:
        out[MODEL_PARTS[f"{side}_foot"]] = carried(parts[f"{side}_foot"], constants.get(side))
        # A hand's neutral is its mean against the forearm; nothing measures the palm's side in most rigs.
        forearm, hand = out[MODEL_PARTS[f"{side}_forearm"]], quats[:, parts[f"{side}_hand"]]
        out[MODEL_PARTS[f"{side}_hand"]] = rot.multiply(
            hand, rot.conjugate(mean_rotation(rot.multiply(rot.conjugate(forearm), hand)))[None]
        )
    _spread_spine(out, {k: carried(j) for k, j in _spine_slots(body_map).items()})
    out.setdefault("Neck", out["Spine3"])
    out.setdefault("Head", out["Neck"])
    for side in ("Right", "Left"):
        out.setdefault(f"{side}Shoulder", out["Spine3"])
    return out


_LIMBS = (("thigh", "shin", "foot"), ("arm", "forearm", "hand"))


def _limb(
    model: Skeleton,
    model_rest: dict[str, Array],
    body_map: BodyMap,
    quats: Array,
    points: dict[str, Array],
    side: str,
    names: tuple[str, str, str],
) -> Limb:
    upper, lower, end = (f"{side}_{name}" for name in names)
    joints = (body_map.frame(upper), body_map.frame(lower))
    toe = points.get(f"{side}_toe") if names[2] == "foot" else None
    return Limb(
        parts=(upper, lower),
        joints=joints,
        quats=quats[:, joints].swapaxes(0, 1),
        bones=np.stack([points[lower] - points[upper], points[end] - points[lower]]),
        rest=np.stack([model_rest[lower] - model_rest[upper], model_rest[end] - model_rest[lower]]),
        hinge=_hinge(model, lower),
        toe=None if toe is None else toe - points[end],
    )


def _foot(
    model: Skeleton,
    model_rest: dict[str, Array],
    parts: dict[str, int],
    quats: Array,
    points: dict[str, Array],
    orientations: dict[str, Array],
    side: str,
) -> Foot:
    knee = _hinge(model, f"{side}_shin")
    return Foot(
        joint=parts[f"{side}_foot"],
        quats=quats[:, parts[f"{side}_foot"]],
        ankle=points[f"{side}_foot"],
        toe=points[f"{side}_toe"],
        across=rot.rotate(orientations[MODEL_PARTS[f"{side}_shin"]], knee[None]),
        model_toe=model_rest[f"{side}_toe"] - model_rest[f"{side}_foot"],
        model_across=knee,
    )


def _hinge(model: Skeleton, part: str) -> Array:
    """The axis ``[3]`` of a model's knee or elbow."""
    return np.array(model.joints[model.index(MODEL_PARTS[part])].dofs[0].axis)


def _leg_length(points: dict[str, Array]) -> float:
    """Hip to ankle along the bones, m: medians over the clip, mean of both sides."""
    bones = [(f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in (("thigh", "shin"), ("shin", "foot"))]
    return sum(float(np.median(np.linalg.norm(points[a] - points[b], axis=1))) for a, b in bones) / 2


def _spine_slots(body_map: BodyMap) -> dict[int, int]:
    """Model spine joint 0..3 -> source joint: first to first, last to last (a single one to the last)."""
    n = len(body_map.spine)
    return {3 if n == 1 else round(k * 3 / (n - 1)): joint for k, joint in enumerate(body_map.spine)}


def _spread_spine(out: dict[str, Array], known: dict[int, Array]) -> None:
    """Fill the model's spine joints that have no source by slerp between their neighbours."""
    chain = {-1: out["Hips"]} | known
    for k, name in enumerate(MODEL_SPINE):
        below, above = max(j for j in chain if j <= k), min(j for j in chain if j >= k)
        if below == above:
            out[name] = chain[k]
            continue
        part = rot.to_rotvec(rot.multiply(rot.conjugate(chain[below]), chain[above]))
        out[name] = rot.multiply(chain[below], rot.from_rotvec(part * (k - below) / (above - below)))


def _report(
    model: Skeleton,
    qpos: Array,
    scaled: dict[str, Array],
    orientations: dict[str, Array],
    limits: Array,
    body_map: BodyMap,
    scale: float,
) -> RetargetReport:
    _, quats = forward_kinematics(model, qpos)
    reached = model_points(model, qpos)
    mm, degrees, worst = {}, {}, {}
    for part, target in scaled.items():
        distance = 1000 * np.linalg.norm(reached[part] - target, axis=1)
        mm[part] = (float(distance.mean()), float(distance.max()))
        worst[part] = int(distance.argmax())
    for part, name in MODEL_PARTS.items():
        if part in body_map.parts:
            off = rot.multiply(rot.conjugate(orientations[name]), quats[:, model.index(name)])
            angle = np.rad2deg(np.linalg.norm(rot.to_rotvec(off), axis=1))
            degrees[part] = (float(angle.mean()), float(angle.max()))
    joints = qpos[:, 7:]
    stuck = ((joints <= limits[:, 0] + 1e-6) | (joints >= limits[:, 1] - 1e-6)).mean(axis=0)
    names = [f"{j.name}_{k}" for j in model.joints for k in range(len(j.dofs))]
    at_limit = {n: float(s) for n, s in zip(names, stuck, strict=True) if s > 0}
    return RetargetReport(mm, degrees, at_limit, body_map.unmapped, scale, worst_frame=worst)
