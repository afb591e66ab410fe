"""A motion of any humanoid skeleton onto the model's, with a report of the error it makes.

1. The source's *calibration pose* (its zero pose or its first frame, whichever stands more like a person) fixes how each
   source joint's frame lies against the model's: by the smallest rotation that brings the bones together.
2. Joint orientations carry over; hinges are read off them.
3. Inverse kinematics on the joint positions, bone by bone scaled to the model's lengths, takes out what the model's fewer
   degrees of freedom (one at knee and elbow) leave over.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from egopose.errors import InputError
from egopose.motion import rotations as rot
from egopose.motion.inverse_kinematics import Targets, solve
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.mapping import SIDES, BodyMap, identify
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
MODEL_SPINE = ("Spine", "Spine1", "Spine2", "Spine3")
#: Links along which positions are scaled: part -> the part it is measured from.
_LINKS = {"neck": "hips", "head": "neck"} | {
    f"{side}_{part}": above if above in ("hips", "neck") else f"{side}_{above}"
    for side in SIDES
    for part, above in {
        "thigh": "hips",
        "shin": "thigh",
        "foot": "shin",
        "toe": "foot",
        "arm": "neck",
        "forearm": "arm",
        "hand": "forearm",
    }.items()
}
#: The bone whose direction calibrates a part's frame: part -> the part at its far end.
_BONES = {"hips": "neck", "neck": "head"} | {
    f"{side}_{part}": f"{side}_{end}"
    for side in SIDES
    for part, end in {
        "clavicle": "arm",
        "arm": "forearm",
        "forearm": "hand",
        "thigh": "shin",
        "shin": "foot",
        "foot": "toe",
    }.items()
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
    notes: tuple[str, ...] = field(default=())

    def table(self) -> str:
        """The report as text, worst joints first."""
        lines = [f"scale {self.scale:.3f}; ground shift {self.ground_shift_m[0] * 100:.1f} cm"]
        lines.append(f"{'part':<16}{'mean mm':>9}{'max mm':>9}{'mean deg':>10}{'max deg':>9}")
        for part in sorted(set(self.position_mm) | set(self.orientation_deg), key=lambda p: -self.position_mm.get(p, (0, 0))[0]):
            mm, deg = self.position_mm.get(part, (np.nan, np.nan)), self.orientation_deg.get(part, (np.nan, np.nan))
            lines.append(f"{part:<16}{mm[0]:>9.1f}{mm[1]:>9.1f}{deg[0]:>10.1f}{deg[1]:>9.1f}")
        if self.at_limit:
            lines.append("at a limit: " + ", ".join(f"{k} {v:.0%}" for k, v in self.at_limit.items()))
        lines.append("dropped bones: " + (", ".join(self.unmapped) or "none"))
        return "\n".join([*lines, *self.notes])


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
    body_map = identify(motion.skeleton, overrides)
    positions, quats = motion.forward_kinematics()
    calibration_positions, calibration_quats = _calibration(motion, body_map, positions, quats)
    model_rest = _model_positions(model, model.rest_qpos()[None])[0]

    points = _part_positions(body_map, positions, quats, motion.skeleton)
    calibration = _part_positions(body_map, calibration_positions[None], calibration_quats[None], motion.skeleton)
    calibration = {part: p[0] for part, p in calibration.items()}
    facing = _facing(calibration)

    orientations = _orientations(body_map, model, quats, calibration_quats, calibration, model_rest, facing)
    start = _read_hinges(model, orientations, limits)
    scaled, scale = _scale(points, calibration, model_rest)
    start[:, :3] = scaled["hips"]
    targets = _targets(model, scaled, orientations)
    qpos = solve(model, start, targets, limits)
    qpos[:, 3:7] = rot.continuous(qpos[:, 3:7])
    out = Motion(model, qpos, motion.fps, motion.name, meta=dict(motion.meta))
    return out, _report(model, qpos, scaled, orientations, limits, body_map, scale)


def _part_positions(body_map: BodyMap, positions: Array, quats: Array, skeleton: Skeleton) -> dict[str, Array]:
    """World positions ``[T, 3]`` of every part. A missing toe is the foot's tip; a missing neck the chest joint."""
    points = {part: positions[:, i] for part, i in body_map.parts.items()}
    points.setdefault("neck", positions[:, body_map.parts["head"]])
    for side in SIDES:
        if f"{side}_toe" not in points:
            foot = body_map.parts[f"{side}_foot"]
            tips = skeleton.joints[foot].tips
            if tips and np.linalg.norm(tips[0]) > 0.02:
                points[f"{side}_toe"] = positions[:, foot] + rot.rotate(quats[:, foot], np.array(tips[0])[None])
    if np.linalg.norm(points["neck"] - points["head"], axis=-1).max() < 1e-6:
        tips = skeleton.joints[body_map.parts["head"]].tips
        if tips and np.linalg.norm(tips[0]) > 0.02:
            head = body_map.parts["head"]
            points["head"] = positions[:, head] + rot.rotate(quats[:, head], np.array(tips[0])[None])
        else:
            del points["head"]
    return points


def _uprightness(points: dict[str, Array]) -> Array:
    """``[T]``: how much a pose looks like standing straight: legs and trunk along z, left and right level. At most 1."""
    def along(lower: str, upper: str) -> Array:
        bone = points[upper] - points[lower]
        return bone[:, 2] / np.maximum(np.linalg.norm(bone, axis=1), 1e-9)

    legs = [along(f"{s}_foot", f"{s}_shin") + along(f"{s}_shin", f"{s}_thigh") for s in SIDES]
    return (sum(legs) + 2 * along("hips", "neck")) / 6.0


def _calibration(motion: Motion, body_map: BodyMap, positions: Array, quats: Array) -> tuple[Array, Array]:
    """Positions ``[J, 3]`` and quaternions ``[J, 4]`` of the pose that tells how frames lie.

    The zero pose if it stands upright (most rigs), else the first frame (a T-pose in many exports), else the most upright
    frame there is.
    """
    zero = np.tile(motion.skeleton.rest_qpos(), (len(_AXIS_TURNS), 1))
    zero[:, 3:7] = _AXIS_TURNS
    zero_positions, zero_quats = forward_kinematics(motion.skeleton, zero)
    stands = _uprightness(_part_positions(body_map, zero_positions, zero_quats, motion.skeleton))
    best = int(np.argmax(stands))
    if stands[best] > 0.97:
        return zero_positions[best], zero_quats[best]
    upright = _uprightness(_part_positions(body_map, positions, quats, motion.skeleton))
    frame = 0 if upright[0] > 0.97 else int(np.argmax(upright))
    return positions[frame], quats[frame]


#: The turns that bring +z, -z, +y, -y, +x, -x of a file's zero pose to +z.
_AXIS_TURNS = np.stack([rot.between(np.array(a, dtype=float), np.array([0.0, 0.0, 1.0])) for a in
                        ((0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0))])  # fmt: skip


def _facing(points: dict[str, Array]) -> Array:
    """Heading quaternion ``[4]`` of a standing pose: x forward, at right angles to hips and shoulders."""
    left = sum(points[f"left_{p}"] - points[f"right_{p}"] for p in ("thigh", "arm"))
    forward = np.cross(left, np.array([0.0, 0.0, 1.0]))
    angle = np.arctan2(forward[1], forward[0])
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def _orientations(
    body_map: BodyMap,
    model: Skeleton,
    quats: Array,
    calibration_quats: Array,
    calibration: dict[str, Array],
    model_rest: dict[str, Array],
    facing: Array,
) -> dict[str, Array]:
    """World quaternions ``[T, 4]`` for the model's joints, carried over from the source's."""
    def carried(source: int, aligned: Array) -> Array:
        moved = rot.multiply(quats[:, source], rot.conjugate(calibration_quats[source])[None])
        return rot.multiply(moved, rot.multiply(aligned, facing)[None])

    def alignment(part: str) -> Array:
        """The smallest turn (in the source's world) that lays the model's bone along the source's."""
        end = _BONES.get(part)
        if part == "hips" or end not in calibration or end not in model_rest:
            return np.array([1.0, 0.0, 0.0, 0.0])
        at = part if part in model_rest else "neck"
        model_bone = rot.rotate(facing, model_rest[end] - model_rest[at])
        return rot.between(model_bone, calibration[end] - calibration[part])

    out = {MODEL_PARTS[part]: carried(index, alignment(part)) for part, index in body_map.parts.items() if part in MODEL_PARTS}
    # The source's n spine joints, first to first and last to last; those between are spread by slerp.
    n = len(body_map.spine)
    known = {3 if n == 1 else round(k * 3 / (n - 1)): i for k, i in enumerate(body_map.spine)}
    aligned = np.array([1.0, 0.0, 0.0, 0.0])
    chain = {-1: out["Hips"]} | {k: carried(i, aligned) for k, i in known.items()}
    for k, name in enumerate(MODEL_SPINE):
        below, above = max(j for j in chain if j <= k), min(j for j in chain if j >= k)
        if below != above:
            part = rot.to_rotvec(rot.multiply(rot.conjugate(chain[below]), chain[above]))
            out[name] = rot.multiply(chain[below], rot.from_rotvec(part * (k - below) / (above - below)))
        else:
            out[name] = chain[k]
    out.setdefault("Neck", out["Spine3"])
    out.setdefault("Head", out["Neck"])
    for side in ("Right", "Left"):
        out.setdefault(f"{side}Shoulder", out["Spine3"])
    return out


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
        centre = (low + high) / 2
        angles = np.unwrap(angles, axis=0)
        # The branch nearest the middle of the range, decided once a clip so that time stays smooth.
        angles = angles - 2 * np.pi * np.round((np.median(angles, axis=0) - centre) / (2 * np.pi))
        qpos[:, columns] = np.clip(angles, low, high)
        reached = np.broadcast_to(np.array([1.0, 0, 0, 0]), (frames, 4))
        for k, axis in enumerate(axes):
            reached = rot.multiply(reached, rot.from_axis_angle(axis, qpos[:, columns.start + k]))
        quats.append(rot.multiply(parent, reached))
    return qpos


def _model_positions(model: Skeleton, qpos: Array) -> list[dict[str, Array]]:
    """For each frame, the model's position of every part that has one (toe: the foot's tip)."""
    positions, quats = forward_kinematics(model, qpos)
    frames = []
    for t in range(len(qpos)):
        points = {part: positions[t, model.index(name)] for part, name in MODEL_PARTS.items()}
        for side in SIDES:
            foot = model.index(f"{side.capitalize()}Foot")
            tip = np.array(model.joints[foot].tips[0])
            points[f"{side}_toe"] = positions[t, foot] + rot.rotate(quats[t, foot], tip)
        frames.append(points)
    return frames


def _scale(
    points: dict[str, Array], calibration: dict[str, Array], model_rest: dict[str, Array]
) -> tuple[dict[str, Array], float]:
    """Source positions with every link stretched to the model's length; the root by the ratio of the legs."""
    def leg(p: dict[str, Array]) -> float:
        return float(
            sum(np.linalg.norm(p[f"{s}_{a}"] - p[f"{s}_{b}"]) for s in SIDES for a, b in (("thigh", "shin"), ("shin", "foot")))
        )

    scale = leg(model_rest) / leg(calibration)
    scaled = {"hips": points["hips"] * scale}
    for part, above in _LINKS.items():
        if part not in points or above not in points:
            continue
        length = np.linalg.norm(calibration[part] - calibration[above])
        if length < 0.02:
            continue
        ratio = np.linalg.norm(model_rest[part] - model_rest[above]) / length
        scaled[part] = scaled[above] + (points[part] - points[above]) * ratio
    return scaled, scale


def _targets(model: Skeleton, scaled: dict[str, Array], orientations: dict[str, Array]) -> Targets:
    joint, offset, position, weight = [], [], [], []
    for part, target in scaled.items():
        name = f"{part.split('_')[0].capitalize()}Foot" if part.endswith("_toe") else MODEL_PARTS[part]
        index = model.index(name)
        joint.append(index)
        offset.append(model.joints[index].tips[0] if part.endswith("_toe") else (0.0, 0.0, 0.0))
        position.append(target)
        # The trunk is only as stiff as its joints allow; limbs and above all feet must arrive.
        weight.append({"foot": 2.0, "toe": 1.5, "neck": 0.5, "head": 0.5, "arm": 0.5}.get(part.split("_")[-1], 1.0))
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
    positions, quats = forward_kinematics(model, qpos)
    mm, degrees = {}, {}
    for part, target in scaled.items():
        if part.endswith("_toe"):
            foot = model.index(f"{part.split('_')[0].capitalize()}Foot")
            point = positions[:, foot] + rot.rotate(quats[:, foot], np.array(model.joints[foot].tips[0])[None])
        else:
            point = positions[:, model.index(MODEL_PARTS[part])]
        distance = 1000 * np.linalg.norm(point - target, axis=1)
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


def require_humanoid(motion: Motion) -> BodyMap:
    """The body map, or one clear error. Raises InputError."""
    try:
        return identify(motion.skeleton)
    except InputError as error:
        raise InputError(motion.name or "motion", error.field, error.cause) from None
