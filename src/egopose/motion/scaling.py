"""Where the model's parts should be: the source's positions, bone by bone at the model's lengths."""

from __future__ import annotations

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.inverse_kinematics import Targets
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.mapping import SIDES
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


def scaled_positions(
    points: dict[str, Array], stance: dict[str, Array], orientations: dict[str, Array], model_rest: dict[str, Array]
) -> tuple[dict[str, Array], float]:
    """Source positions with every link stretched to the model's length, measured from the middle of the hip joints.

    Limbs keep the source's directions; feet lie as their orientations say. Inside the trunk rigs place joints
    differently (a root above the hips, a neck ahead of the spine): those links are first turned by what sets the
    source's neutral stance apart from the model's.
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
        if part.endswith("toe"):
            # The line from ankle to toe is as steep as the rig has it; the model's foot has its own.
            link = rot.rotate(orientations[MODEL_PARTS[above]], model_link[None])
        elif frame is not None:
            bias = rot.between(stance[part] - stance[above], model_link)
            local = rot.rotate(rot.conjugate(orientations[frame]), link)
            link = rot.rotate(orientations[frame], rot.rotate(bias[None], local))
        size = np.linalg.norm(model_link) / float(np.median(np.linalg.norm(link, axis=1)))
        scaled[part] = scaled[above] + link * size
    hips = model_rest["hips"] - model_rest["centre"]
    scaled["hips"] = scaled.pop("centre") + rot.rotate(orientations["Hips"], hips[None])
    return scaled, scale


def ik_targets(model: Skeleton, scaled: dict[str, Array], orientations: dict[str, Array]) -> Targets:
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
