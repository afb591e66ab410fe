"""A motion of any humanoid skeleton onto the model's, with a report of the error it makes.

1. :mod:`egopose.motion.calibration` finds how each source joint's frame lies in the model's.
2. Joint orientations carry over; hinges are read off them.
3. Inverse kinematics on the joint positions, bone by bone scaled to the model's lengths, takes out what the model's
   fewer degrees of freedom (one at knee and elbow) leave over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.motion import rotations as rot
from egopose.motion.calibration import (
    align,
    angle_between,
    bend_axis,
    bone_direction,
    floor_normal,
    mean_rotation,
    neutral_stance,
    part_positions,
)
from egopose.motion.inverse_kinematics import Targets, solve_in_time
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.mapping import SIDES, BodyMap, identify, sample
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: The model's joint for each part of :class:`BodyMap`; the spine is spread over the four spine joints.
MODEL_PARTS = {"hips": "Hips", "neck": "Neck", "head": "Head"} | {
    f"{side}_{part}": side.capitalize() + joint
    for side in SIDES
    for part, joint in {
        "clavicle": "Shoulder",
        "arm": "Arm",
        "forearm": "ForeArm",
        "hand": "Hand",
        "thigh": "UpLeg",
        "shin": "Leg",
        "foot": "Foot",
    }.items()
}
_UP = np.array([0.0, 0.0, 1.0])
#: How far the angle between a foot's bone and the floor's normal may be from the model's, rad (20 degrees).
_FLAT_FOOT = np.deg2rad(20.0)
#: Mean sine of a limb's bend below which its bend axis is not known.
_BEND_EVIDENCE = 0.05
MODEL_SPINE = ("Spine", "Spine1", "Spine2", "Spine3")
#: Links along which positions are scaled: part -> the part it is measured from.
_LINKS = {"neck": "centre", "head": "neck", "crown": "neck"} | {
    f"{side}_{part}": above if above in ("centre", "neck") else f"{side}_{above}"
    for side in SIDES
    for part, above in {
        "thigh": "centre",
        "shin": "thigh",
        "foot": "shin",
        "toe": "foot",
        "arm": "neck",
        "forearm": "arm",
        "hand": "forearm",
    }.items()
}
#: Links inside the trunk -> the model joint whose frame they are constant or nearly constant in.
_TRUNK_LINKS = {"neck": "Hips", "head": "Neck", "crown": "Neck"} | {
    f"{side}_{part}": joint for side in SIDES for part, joint in {"thigh": "Hips", "arm": "Spine3"}.items()
}


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
    """

    position_mm: dict[str, tuple[float, float]]
    orientation_deg: dict[str, tuple[float, float]]
    at_limit: dict[str, float]
    unmapped: tuple[str, ...]
    scale: float
    ground_shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

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
    neutral, stance = neutral_stance(motion, body_map, quats, points)
    orientations = _orientations(motion, body_map, model, model_rest, quats, points, neutral)
    start = _read_hinges(model, orientations, limits)
    scaled, scale = _scale(points, stance, orientations, model_rest)
    start[:, :3] = scaled["hips"]
    targets = _targets(model, scaled, orientations)
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
    neutral: Array,
) -> dict[str, Array]:
    """World quaternions ``[T, 4]`` for the model's joints, carried over from the source's."""
    parts, out = body_map.parts, {}

    def carried(joint: int, constant: Array | None = None) -> Array:
        return rot.multiply(quats[:, joint], (rot.conjugate(neutral[joint]) if constant is None else constant)[None])

    for part in ("hips", "neck", "head", "left_clavicle", "right_clavicle"):
        if part in parts:
            out[MODEL_PARTS[part]] = carried(parts[part])
    for side in SIDES:
        for chain in (("thigh", "shin", "foot"), ("arm", "forearm", "hand")):
            out.update(
                _limb_orientations(model, model_rest, body_map, quats, points, [f"{side}_{p}" for p in chain], carried)
            )
        foot, toe = f"{side}_foot", f"{side}_toe"
        constant = None
        if toe in points:
            direction = bone_direction(quats[:, parts[foot]], points[toe] - points[foot])
            normal = floor_normal(quats[:, parts[foot]], points[foot], points[toe], motion.fps)
            model_toe = model_rest[toe] - model_rest[foot]
            if abs(angle_between(normal, direction) - angle_between(_UP, model_toe)) < _FLAT_FOOT:
                constant = align((normal, direction), (_UP, model_toe))
            else:
                # A dancer on the tips of the toes never shows the floor's normal: then the ankle's mean turn against
                # the knee's axis is taken for none.
                knee = np.array(model.joints[model.index(MODEL_PARTS[f"{side}_shin"])].dofs[0].axis)
                across = bone_direction(quats[:, parts[foot]], rot.rotate(out[MODEL_PARTS[f"{side}_shin"]], knee[None]))
                constant = align((direction, across), (model_toe, knee))
        out[MODEL_PARTS[foot]] = carried(parts[foot], constant)
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


def _limb_orientations(
    model: Skeleton,
    model_rest: dict[str, Array],
    body_map: BodyMap,
    quats: Array,
    points: dict[str, Array],
    chain: list[str],
    carried: Callable[..., Array],
) -> dict[str, Array]:
    """Orientations of a limb's two long bones from bone direction and bend axis; the neutral pose if it never bends."""
    upper, lower, end = chain
    bones = {upper: points[lower] - points[upper], lower: points[end] - points[lower]}
    rest = {upper: model_rest[lower] - model_rest[upper], lower: model_rest[end] - model_rest[lower]}
    hinge = np.array(model.joints[model.index(MODEL_PARTS[lower])].dofs[0].axis)
    out = {}
    for part in (upper, lower):
        frame = quats[:, body_map.frame(part)]
        axis, evidence = bend_axis(frame, bones[upper], bones[lower])
        constant = None
        if evidence > _BEND_EVIDENCE:
            constant = align((bone_direction(frame, bones[part]), axis), (rest[part], hinge))
        out[MODEL_PARTS[part]] = carried(body_map.frame(part), constant)
    return out


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


def _read_hinges(model: Skeleton, orientations: dict[str, Array], limits: Array) -> Array:
    """``[T, nq]`` from world orientations: three hinges by Euler angles, one by its twist about the axis."""
    frames = len(orientations["Hips"])
    qpos = np.zeros((frames, model.nq))
    qpos[:, 3:7] = orientations["Hips"]
    quats: list[Array] = [orientations["Hips"]]
    for j, joint in enumerate(model.joints[1:], start=1):
        parent = quats[joint.parent]
        local = rot.multiply(rot.conjugate(parent), orientations[joint.name])
        axes = np.array([d.axis for d in joint.dofs])
        columns = slice(7 + model.dof_slices[j].start, 7 + model.dof_slices[j].stop)
        if len(axes) == 1:
            along = np.sum(local[:, 1:] * axes[0], axis=1)
            angles = 2.0 * np.arctan2(along, local[:, 0])[:, None]
        else:
            angles = Rotation.as_davenport(rot.to_scipy(local), axes, "intrinsic")
        low, high = limits[model.dof_slices[j], 0], limits[model.dof_slices[j], 1]
        qpos[:, columns] = np.clip(_within(angles, axes, low, high), low, high)
        reached = np.broadcast_to(np.array([1.0, 0, 0, 0]), (frames, 4))
        for k, axis in enumerate(axes):
            reached = rot.multiply(reached, rot.from_axis_angle(axis, qpos[:, columns.start + k]))
        quats.append(rot.multiply(parent, reached))
    return qpos


def _within(angles: Array, axes: Array, low: Array, high: Array) -> Array:
    """The equal set of angles ``[T, d]`` about ``axes [d, 3]`` that fits the limits best.

    Three hinges reach every orientation twice, (a, b, c) and (a + pi, 2 lock - b, c + pi), where ``lock`` is the middle
    angle that lays the third axis along the first; and each angle may be moved by a whole turn.
    """
    centre = (low + high) / 2
    ways = [angles]
    if len(axes) == 3:
        lock = np.arctan2(np.dot(np.cross(axes[2], axes[0]), axes[1]), np.dot(axes[2], axes[0]))
        ways.append(angles * [1, -1, 1] + [np.pi, 2 * lock, np.pi])
    ways = [w - 2 * np.pi * np.round((w - centre) / (2 * np.pi)) for w in ways]
    # Outside the limits costs most; inside, the nearer the middle the better, which keeps time smooth.
    cost = [np.sum((w - np.clip(w, low, high)) ** 2 + 0.01 * (w - centre) ** 2, axis=1) for w in ways]
    return np.take_along_axis(np.stack(ways), np.argmin(cost, axis=0)[None, :, None], axis=0)[0]


def model_points(model: Skeleton, qpos: Array) -> dict[str, Array]:
    """The model's position ``[T, 3]`` of every part (toe and crown: tips)."""
    positions, quats = forward_kinematics(model, qpos)
    points = {part: positions[:, model.index(name)] for part, name in MODEL_PARTS.items()}
    for part, (joint, tip) in _tips(model).items():
        points[part] = positions[:, joint] + rot.rotate(quats[:, joint], tip[None])
    return points


def _tips(model: Skeleton) -> dict[str, tuple[int, Array]]:
    joints = {f"{side}_toe": model.index(f"{side.capitalize()}Foot") for side in SIDES} | {"crown": model.index("Head")}
    return {part: (j, np.array(model.joints[j].tips[0])) for part, j in joints.items()}


def _scale(
    points: dict[str, Array], stance: dict[str, Array], orientations: dict[str, Array], model_rest: dict[str, Array]
) -> tuple[dict[str, Array], float]:
    """Source positions with every link stretched to the model's length, measured from the middle of the hip joints.

    Limbs keep the source's directions. Inside the trunk rigs place joints differently (a root above the hips, a neck
    ahead of the spine): those links are first turned by what sets the source's neutral stance apart from the model's.
    """

    def with_centre(p: dict[str, Array]) -> dict[str, Array]:
        return p | {"centre": (p["left_thigh"] + p["right_thigh"]) / 2}

    points, stance, model_rest = with_centre(points), with_centre(stance), with_centre(model_rest)

    def length(part: str, above: str) -> float:
        return float(np.median(np.linalg.norm(points[part] - points[above], axis=1)))

    legs = [(f"{s}_{a}", f"{s}_{b}") for s in SIDES for a, b in (("shin", "thigh"), ("foot", "shin"))]
    scale = sum(float(np.linalg.norm(model_rest[a] - model_rest[b])) for a, b in legs) / sum(
        length(a, b) for a, b in legs
    )
    scaled = {"centre": points["centre"] * scale}
    for part, above in _LINKS.items():
        if part not in points or above not in scaled or length(part, above) < 0.02:
            continue
        link, model_link = points[part] - points[above], model_rest[part] - model_rest[above]
        frame = _TRUNK_LINKS.get(part)
        if frame is not None:
            bias = rot.between(stance[part] - stance[above], model_link)
            local = rot.rotate(rot.conjugate(orientations[frame]), link)
            link = rot.rotate(orientations[frame], rot.rotate(bias[None], local))
        scaled[part] = scaled[above] + link * np.linalg.norm(model_link) / length(part, above)
    hips = model_rest["hips"] - model_rest["centre"]
    scaled["hips"] = scaled.pop("centre") + rot.rotate(orientations["Hips"], hips[None])
    return scaled, scale


def _targets(model: Skeleton, scaled: dict[str, Array], orientations: dict[str, Array]) -> Targets:
    tips = _tips(model)
    joint, offset, position, weight = [], [], [], []
    for part, target in scaled.items():
        index, tip = tips.get(part) or (model.index(MODEL_PARTS[part]), np.zeros(3))
        joint.append(index)
        offset.append(tip)
        position.append(target)
        # The trunk is only as stiff as its joints allow; limbs and above all feet must arrive.
        weight.append({"foot": 2.0, "toe": 1.0, "neck": 0.5, "head": 0.5, "arm": 0.5}.get(part.split("_")[-1], 1.0))
    # Metres a radian: orientation decides only what positions leave open.
    frame_weight = {"Hips": 0.2, "Head": 0.1, "RightHand": 0.05, "LeftHand": 0.05, "RightFoot": 0.05, "LeftFoot": 0.05}
    spine = dict.fromkeys((*MODEL_SPINE, "Neck", "RightShoulder", "LeftShoulder", "RightArm", "LeftArm"), 0.02)
    thighs = dict.fromkeys(("RightUpLeg", "LeftUpLeg"), 0.01)
    weights = frame_weight | spine | thighs
    names = [n for n in weights if n in orientations]
    return Targets(
        np.array(joint),
        np.array(offset),
        np.stack(position, axis=1),
        np.array(weight),
        np.array([model.index(n) for n in names]),
        np.stack([orientations[n] for n in names], axis=1),
        np.array([weights[n] for n in names]),
    )


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
    mm, degrees = {}, {}
    for part, target in scaled.items():
        distance = 1000 * np.linalg.norm(reached[part] - target, axis=1)
        mm[part] = (float(distance.mean()), float(distance.max()))
    for part, name in MODEL_PARTS.items():
        if part in body_map.parts:
            off = rot.multiply(rot.conjugate(orientations[name]), quats[:, model.index(name)])
            angle = np.rad2deg(np.linalg.norm(rot.to_rotvec(off), axis=1))
            degrees[part] = (float(angle.mean()), float(angle.max()))
    joints = qpos[:, 7:]
    stuck = ((joints <= limits[:, 0] + 1e-6) | (joints >= limits[:, 1] - 1e-6)).mean(axis=0)
    names = [f"{j.name}_{k}" for j in model.joints for k in range(len(j.dofs))]
    at_limit = {n: float(s) for n, s in zip(names, stuck, strict=True) if s > 0}
    return RetargetReport(mm, degrees, at_limit, body_map.unmapped, scale)
