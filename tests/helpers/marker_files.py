"""Marker files of a motion as other programs name and write them, for the tests of their readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.io.frames import up_rotation
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: What each layout lacks of all points there are here.
_WITHOUT = {
    "HALPE_26": ("Ear", "Eye", "Index", "Pinky"),
    "BODY_25": ("Index", "Pinky", "Head"),
    "mediapipe": ("SmallToe", "Head", "Neck"),
    "COCO_17": ("Toe", "Heel", "Index", "Pinky", "Head", "Neck"),
}


def layout(motion: Motion, kind: str) -> dict[str, Array]:
    """Points ``[T, 3]`` (m, z up) of a motion on the humanoid, named as a pose network's layout has them."""
    positions, quats = motion.forward_kinematics()

    def at(joint: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
        k = motion.skeleton.index(joint)
        return positions[:, k] + rot.rotate(quats[:, k], np.broadcast_to(np.array([x, y, z]), positions[:, k].shape))

    points = {"Nose": at("Head", 0.13, 0.0, 0.035), "Head": at("Head", 0.0, 0.0, 0.2)}
    for side, s in (("Right", -1.0), ("Left", 1.0)):
        letter = side[0]
        for name, joint in (("Hip", "UpLeg"), ("Knee", "Leg"), ("Ankle", "Foot")):
            points[letter + name] = at(side + joint)
        for name, joint in (("Shoulder", "Arm"), ("Elbow", "ForeArm"), ("Wrist", "Hand")):
            points[letter + name] = at(side + joint)
        points[f"{letter}BigToe"] = at(f"{side}Foot", 0.16, -0.02 * s, -0.06)
        points[f"{letter}SmallToe"] = at(f"{side}Foot", 0.13, 0.05 * s, -0.06)
        points[f"{letter}Heel"] = at(f"{side}Foot", -0.05, 0.0, -0.06)
        points[f"{letter}Ear"] = at("Head", 0.02, 0.07 * s, 0.06)
        points[f"{letter}Eye"] = at("Head", 0.1, 0.03 * s, 0.07)
        points[f"{letter}Index"] = at(f"{side}Hand", 0.03, 0.09 * s, 0.0)
        points[f"{letter}Pinky"] = at(f"{side}Hand", -0.03, 0.08 * s, 0.0)
    points["Neck"] = (points["RShoulder"] + points["LShoulder"]) / 2
    points = {k: v for k, v in points.items() if not any(word in k for word in _WITHOUT[kind])}
    return {_mediapipe(k): v for k, v in points.items()} if kind == "mediapipe" else points


def _mediapipe(name: str) -> str:
    if name == "Nose":
        return "nose"
    word = {"BigToe": "foot_index"}.get(name[1:], name[1:].lower())
    return ("left_" if name[0] == "L" else "right_") + word


def in_file(points: dict[str, Array], up: str, metres: float) -> Array:
    """``[T, P, 3]`` in a file's axes and unit."""
    return rot.rotate(rot.conjugate(up_rotation(up)), np.stack(list(points.values()), axis=1)) / metres


def write_layout(
    path: Path, points: dict[str, Array], fps: float = 30.0, *, up: str = "y", unit: str = "m", rate: str | None = None
) -> None:
    """A TRC as Pose2Sim writes it; NaN becomes an empty field."""
    values = in_file(points, up, {"m": 1.0, "mm": 0.001}[unit])
    said = rate or f"{fps:g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{said}\t{said}\t{len(values)}\t{len(points)}\t{unit}\t{said}\t0\t{len(values)}",
        "Frame#\tTime\t" + "\t\t\t".join(points) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(points)) for axis in "XYZ"),
    ]
    for t, row in enumerate(values.reshape(len(values), -1).tolist()):
        lines.append(f"{t}\t{t / fps:.6f}\t" + "\t".join("" if np.isnan(v) else f"{v:.6f}" for v in row))
    path.write_text("\n".join(lines) + "\n")
