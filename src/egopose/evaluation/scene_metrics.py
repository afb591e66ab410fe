"""How far a motion among boxes that was recovered from pictures is from the true one.

World: z up, floor at 0. Two worlds differ by where they begin and which way x points: the recovered one is turned
about the vertical and moved along the floor until the first frames' pelvises are at one place. Heights are compared as
they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from egopose.evaluation.position_metrics import foot_skate, jitter, mpjpe_root_aligned, w_mpjpe, wa_mpjpe
from egopose.humanoid.foot_geometry import sole_edges
from egopose.humanoid.model import HumanoidModel
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.clip import box_poses
from egopose.scene.scene_file import Scene

#: m off the true pelvis at which a clip is lost.
LOST = 0.5
#: Frames whose headings are laid on each other where nothing tells which way x points.
_FIRST = 10
#: m: a box further from a true one, on the floor, is another.
_SAME_BOX = 1.0


@dataclass(frozen=True)
class SceneMotion:
    """A motion and what it is said to move among.

    Args:
        motion: on the humanoid's skeleton.
        touching: ``[T, 2]`` whether the right and the left foot touch something.
        scene: its boxes; those that lack a place or a height are left out.

    Raises:
        ValueError: not as many contacts as frames.
    """

    motion: Motion
    touching: NDArray[np.bool_]
    scene: Scene

    def __post_init__(self) -> None:
        if self.touching.shape != (len(self.motion), 2):
            raise ValueError(f"touching must be [{len(self.motion)}, 2], got {list(self.touching.shape)}")


def aligned(found: Motion, true: Motion, turn: float | None = None) -> tuple[Motion, float, Array]:
    """The recovered motion in the true world; also the turn (rad) and the shift ``[2]`` (m) that took it there.

    Args:
        found, true: as many frames of one skeleton.
        turn: rad about the vertical, from the recovered world to the true one, where it is known; None for what
            lays the headings of the first ten frames on each other.
    """
    if turn is None:
        apart = (rot.yaw(true.qpos[:, 3:7]) - rot.yaw(found.qpos[:, 3:7]))[:_FIRST]
        turn = float(np.arctan2(np.sin(apart).mean(), np.cos(apart).mean()))
    about = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(turn))
    qpos = found.qpos.copy()
    qpos[:, :3] = rot.rotate(about, qpos[:, :3])
    qpos[:, 3:7] = rot.multiply(about, qpos[:, 3:7])
    shift = true.qpos[0, :2] - qpos[0, :2]
    qpos[:, :2] += shift
    return Motion(found.skeleton, qpos, found.fps, found.name), turn, shift


def scene_figures(
    humanoid: HumanoidModel, found: SceneMotion, true: SceneMotion, turn: float | None = None
) -> dict[str, float]:
    """What a recovered motion is off by.

    Args:
        humanoid: whose skeleton both motions are on.
        found: recovered.
        true: of the same frames.
        turn: see :func:`aligned`.

    Returns:
        ``mpjpe_mm`` with the pelvises laid on each other; ``w_mpjpe100_mm``, ``wa_mpjpe100_mm`` (WHAM, Shin et al.
        CVPR 2024); ``root_percent``, the pelvis's mean distance in % of its true path on the floor and in height;
        ``root_furthest_m``; ``success``, 1 where that stays within 0.5 m; ``contact_accuracy`` over feet and frames;
        ``box_place_m``, ``box_height_m``, means over the true boxes that were recovered; ``boxes_missing`` and
        ``boxes_invented``; ``jitter`` m/s^3; ``foot_skate`` m/s while a foot truly touches; ``penetration_mm``, mean
        depth of the deepest sole corner in the floor or in the motion's own boxes. What nothing tells is NaN.

    Raises:
        ValueError: other frames, rates or skeletons.
    """
    if len(found.motion) != len(true.motion) or found.motion.fps != true.motion.fps:
        raise ValueError(f"{len(found.motion)} frames are compared with {len(true.motion)}, at one rate")
    if found.motion.skeleton != true.motion.skeleton:
        raise ValueError("the motions are on two skeletons")
    motion, turn, shift = aligned(found.motion, true.motion, turn)
    joints, truth = motion.forward_kinematics()[0], true.motion.forward_kinematics()[0]
    off = np.linalg.norm(joints[:, 0] - truth[:, 0], axis=1)
    path = float(np.linalg.norm(np.diff(truth[:, 0], axis=0), axis=1).sum())
    feet = sole_edges(humanoid, motion).reshape(len(motion), len(humanoid.feet), -1, 3).mean(axis=2)
    order = [[humanoid.skeleton.names[foot] for foot in humanoid.feet].index(f"{side}Foot") for side in _SIDES]
    return {
        "mpjpe_mm": 1000 * float(mpjpe_root_aligned(joints, truth).mean()),
        "w_mpjpe100_mm": 1000 * float(w_mpjpe(joints, truth).mean()),
        "wa_mpjpe100_mm": 1000 * float(wa_mpjpe(joints, truth).mean()),
        "root_percent": 100 * float(off.mean()) / path if path > 0 else float("nan"),
        "root_furthest_m": float(off.max()),
        "success": float(off.max() <= LOST),
        "contact_accuracy": float((found.touching == true.touching).mean()),
        **box_errors(found.scene, true.scene, turn, shift),
        "jitter": float(jitter(joints, motion.fps).mean()),
        "foot_skate": foot_skate(feet[:, order], true.touching, motion.fps),
        "penetration_mm": 1000 * float(penetration(sole_edges(humanoid, found.motion), found.scene).mean()),
    }


_SIDES = ("Right", "Left")


def box_errors(found: Scene, true: Scene, turn: float, shift: Array) -> dict[str, float]:
    """Mean distances (m) of the true boxes from those recovered: on the floor, and of their upper faces in height.

    Boxes of one name belong together. Any others are paired by distance, nearest first, within 1 m.

    Args:
        found: in its own world.
        true: in the true one.
        turn, shift: of :func:`aligned`.
    """
    c, s = np.cos(turn), np.sin(turn)
    places, heights = _placed(found)
    truth, true_heights = _placed(true)
    places = {name: np.array([[c, -s], [s, c]]) @ place + shift for name, place in places.items()}
    pairs = {name: name for name in truth if name in places}
    apart = sorted(
        (float(np.linalg.norm(places[one] - truth[name])), name, one)
        for name in truth
        for one in places
        if name not in pairs and one not in pairs
    )
    for distance, name, one in apart:
        if distance <= _SAME_BOX and name not in pairs and one not in pairs.values():
            pairs[name] = one
    place = [float(np.linalg.norm(places[one] - truth[name])) for name, one in pairs.items()]
    height = [abs(heights[one] - true_heights[name]) for name, one in pairs.items()]
    return {
        "box_place_m": float(np.mean(place)) if place else float("nan"),
        "box_height_m": float(np.mean(height)) if height else float("nan"),
        "boxes_missing": float(len(truth) - len(pairs)),
        "boxes_invented": float(len(places) - len(pairs)),
    }


def penetration(points: Array, scene: Scene) -> Array:
    """``[T]`` m: depth of the deepest of ``points [T, P, 3]`` in the floor or a box; 0 where none is in anything.

    In a box, depth is the shortest way out, up or to a side.
    """
    deepest = np.maximum(-points[..., 2], 0.0)
    known = _known(scene)
    for box, top, yaw in zip(known.boxes, *box_poses(known), strict=True):
        c, s = np.cos(yaw), np.sin(yaw)
        local = (points[..., :2] - top[:2]) @ np.array([[c, -s], [s, c]])
        sides = (0.5 * np.array(box.size) - np.abs(local)).min(axis=-1)
        deepest = np.maximum(deepest, np.minimum(sides, top[2] - points[..., 2]))
    return np.asarray(deepest.max(axis=-1))


def _known(scene: Scene) -> Scene:
    """With the boxes whose place, height and yaw are there."""
    return replace(scene, boxes=tuple(box for box in scene.boxes if box.known), contacts=())


def _placed(scene: Scene) -> tuple[dict[str, Array], dict[str, float]]:
    """Places ``[2]`` and heights of the boxes, m, by name."""
    known = _known(scene)
    tops, _ = box_poses(known)
    names = [box.name for box in known.boxes]
    return {n: top[:2] for n, top in zip(names, tops, strict=True)}, dict(zip(names, tops[:, 2].tolist(), strict=True))
