"""Inverse kinematics of mocap with noise and of lifted film, against what is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from film import View
from ik import JOINTS, WAYS, acceleration, persons_skeleton, points_of, solved
from scores import KEYPOINTS, mpjpe

from egopose.humanoid.model import HumanoidModel
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.lifting import POINTS, LiftingNetwork, camera_axes, lift
from egopose.scene.poses.keypoints import HUMANOID_JOINTS

#: Held-out clips that are solved: every eighth, at most this many frames each.
_EVERY, _FRAMES = 8, 60
NOISE = (0.0, 0.03)
#: Of ik's points among POINTS; the tips of the toes are the big toes.
_LIFTED = [POINTS.index(name) for name in (*JOINTS, "left_big_toe", "right_big_toe", "Neck", "Head")]
JUDGED = [JOINTS.index(HUMANOID_JOINTS[name]) for name in KEYPOINTS]


def mocap_figures(humanoid: HumanoidModel, clips: Sequence[Motion]) -> dict[str, dict[str, dict[str, float]]]:
    """``{noise: {way: error over 21 joints in mm, acceleration}}``, the mean over frames of held-out clips."""
    skeleton, random = humanoid.skeleton, np.random.default_rng(0)
    rows: dict[str, dict[str, list[tuple[float, float, int]]]] = {}
    for clip in clips[::_EVERY]:
        truth = clip.qpos[:_FRAMES]
        points, joints = points_of(skeleton, truth), forward_kinematics(skeleton, truth)[0]
        for noise in NOISE:
            noisy = points + noise * random.normal(size=points.shape)
            found = {"truth": truth, **solved(humanoid, skeleton, noisy, clip.fps)}
            for way, qpos in found.items():
                error = 1000 * np.linalg.norm(forward_kinematics(skeleton, qpos)[0] - joints, axis=-1).mean()
                figures = (float(error), acceleration(qpos, clip.fps), len(truth))
                rows.setdefault(f"{1000 * noise:g} mm", {}).setdefault(way, []).append(figures)
    return {
        noise: {
            way: {
                name: float(np.average([one[k] for one in each], weights=[one[2] for one in each]))
                for k, name in enumerate(("error", "acceleration"))
            }
            for way, each in ways.items()
        }
        for noise, ways in rows.items()
    }


def film_points(view: View, network: LiftingNetwork) -> Array:
    """``[T, 16, 3]`` m, z up: ik's points, lifted from the mended keypoints and turned by the calibrated camera."""
    lifted = camera_axes(lift(view.mended, network), view.mended)
    return np.asarray(lifted[:, _LIFTED] @ view.camera.axes)


def film_figures(
    humanoid: HumanoidModel, network: LiftingNetwork, man: list[View]
) -> dict[str, dict[str, dict[str, float]]]:
    """``{view: {way: error over 12 joints in mm, acceleration}}`` on a skeleton of the lifted poses' own lengths."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for view in man:
        points, truth = film_points(view, network), view.truth @ view.camera.axes
        skeleton = persons_skeleton(humanoid.skeleton, points)
        row = {"lifted": {"error": mpjpe(points[:, JUDGED], truth)}}
        for way, qpos in solved(humanoid, skeleton, points, view.track.fps).items():
            joints = points_of(skeleton, qpos)[:, JUDGED]
            row[way] = {"error": mpjpe(joints, truth), "acceleration": acceleration(qpos, view.track.fps)}
        full = np.full(points.shape, np.nan)
        full[:, JUDGED] = truth
        own = persons_skeleton(humanoid.skeleton, full)
        steady = solved(humanoid, own, full, view.track.fps, WAYS[2:])[WAYS[2]]
        row["truth"] = {"error": mpjpe(points_of(own, steady)[:, JUDGED], truth)}
        row["truth"]["acceleration"] = acceleration(steady, view.track.fps)
        out[view.camera.name] = row
    return out
