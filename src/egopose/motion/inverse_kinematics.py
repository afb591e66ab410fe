"""Inverse kinematics of a :class:`Skeleton`, all frames at once: damped Gauss-Newton on positions and orientations."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from egopose.motion import rotations as rot
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton


@dataclass(frozen=True)
class Targets:
    """What the frames should reach.

    Args:
        point_joint: ``[K]`` joint index each point hangs on.
        point_offset: ``[K, 3]`` of the point in that joint's frame, metres.
        positions: ``[T, K, 3]`` where the points should be, metres.
        position_weight: ``[K]``, 1 for a point that counts fully.
        frame_joint: ``[M]`` joints whose orientation counts.
        orientations: ``[T, M, 4]`` quaternions.
        orientation_weight: ``[M]`` metres per radian: what a radian is worth against a metre.
    """

    point_joint: np.ndarray
    point_offset: Array
    positions: Array
    position_weight: Array
    frame_joint: np.ndarray
    orientations: Array
    orientation_weight: Array


@lru_cache(maxsize=32)
def _moves(skeleton: Skeleton) -> np.ndarray:
    """``[J, D]``: does degree of freedom d move joint j?"""
    moves = np.zeros((len(skeleton), skeleton.n_dofs), dtype=bool)
    for j in range(len(skeleton)):
        if j:
            moves[j] = moves[skeleton.parents[j]]
        moves[j, skeleton.dof_slices[j]] = True
    return moves


def _hinge_axes(skeleton: Skeleton, qpos: Array, quats: Array) -> Array:
    """World axes ``[T, D, 3]`` of all degrees of freedom (hinges only)."""
    axes = np.empty((len(qpos), skeleton.n_dofs, 3))
    for j, joint in enumerate(skeleton.joints):
        if not joint.dofs:
            continue
        frame = quats[:, joint.parent]
        for column, dof in zip(range(*skeleton.dof_slices[j].indices(skeleton.n_dofs)), joint.dofs, strict=True):
            axis = np.array(dof.axis)
            axes[:, column] = rot.rotate(frame, np.broadcast_to(axis, (len(qpos), 3)))
            frame = rot.multiply(frame, rot.from_axis_angle(axis, qpos[:, 7 + column]))
    return axes


def solve(
    skeleton: Skeleton,
    start: Array,
    targets: Targets,
    limits: Array | None = None,
    iterations: int = 12,
    damping: float = 1e-3,
    stay: float = 1e-3,
) -> Array:
    """Coordinates whose points and frames come nearest the targets, each frame from its own start.

    Args:
        skeleton: hinges only.
        start: ``[T, nq]``.
        targets: see :class:`Targets`.
        limits: ``[D, 2]`` rad; steps are projected onto them.
        iterations: Gauss-Newton steps.
        damping: Levenberg's, on the step.
        stay: weight of staying at ``start``: it decides what the targets leave open, such as the twist of a straight
            arm.

    Returns:
        ``[T, nq]``.
    """
    chunks = [
        _solve(skeleton, start[i : i + 512], _part(targets, slice(i, i + 512)), limits, iterations, damping, stay)
        for i in range(0, len(start), 512)
    ]
    return np.concatenate(chunks)


def solve_in_time(skeleton: Skeleton, start: Array, targets: Targets, limits: Array | None = None) -> Array:
    """:func:`solve`, then again for frames that ended worse than a neighbour's solution lets them be.

    A frame can be caught in a local minimum (a wrong branch of three hinges); its neighbour seldom is at the same time.
    """
    qpos = solve(skeleton, start, targets, limits)
    cost = _cost(skeleton, qpos, targets)
    for shift in (1, -1) * 4:
        bad = np.flatnonzero(cost > _STUCK**2)
        neighbour = bad + shift
        inside = (neighbour >= 0) & (neighbour < len(qpos))
        bad, neighbour = bad[inside], neighbour[inside]
        if not len(bad):
            break
        moved = qpos[neighbour].copy()
        again = solve(skeleton, moved, _part(targets, bad), limits)
        new_cost = _cost(skeleton, again, _part(targets, bad))
        better = new_cost < cost[bad]
        qpos[bad[better]], cost[bad[better]] = again[better], new_cost[better]
    return qpos


#: Weighted root of the summed squared distances (m) above which a frame is tried again from its neighbours.
_STUCK = 0.05


def _cost(skeleton: Skeleton, qpos: Array, targets: Targets) -> Array:
    """``[T]`` weighted squared distance of all points and frames, m^2."""
    positions, quats = forward_kinematics(skeleton, qpos)
    points = positions[:, targets.point_joint] + rot.rotate(quats[:, targets.point_joint], targets.point_offset[None])
    off = rot.to_rotvec(rot.multiply(targets.orientations, rot.conjugate(quats[:, targets.frame_joint])))
    return np.sum(((targets.positions - points) * targets.position_weight[:, None]) ** 2, axis=(1, 2)) + np.sum(
        (off * targets.orientation_weight[:, None]) ** 2, axis=(1, 2)
    )


def _part(targets: Targets, frames: slice | np.ndarray) -> Targets:
    return Targets(
        targets.point_joint,
        targets.point_offset,
        targets.positions[frames],
        targets.position_weight,
        targets.frame_joint,
        targets.orientations[frames],
        targets.orientation_weight,
    )


def _solve(
    skeleton: Skeleton,
    start: Array,
    targets: Targets,
    limits: Array | None,
    iterations: int,
    damping: float,
    stay: float,
) -> Array:
    n = skeleton.n_dofs
    best, trial = start.copy(), start.copy()
    normal, gradient, cost = _normal_equations(skeleton, trial, start, targets, stay)
    squared = np.full(len(start), damping**2)
    for iteration in range(iterations):
        if iteration:
            # A full step from a nearly straight limb can throw it anywhere: a worse frame goes back and steps shorter.
            new_normal, new_gradient, new_cost = _normal_equations(skeleton, trial, start, targets, stay)
            better = new_cost < cost
            best[better], normal[better], gradient[better] = trial[better], new_normal[better], new_gradient[better]
            cost[better] = new_cost[better]
            squared = np.where(better, np.maximum(squared / 10, damping**2), squared * 30)
        damped = normal + squared[:, None, None] * np.eye(6 + n)
        pull = gradient.copy()
        if limits is not None:
            # A hinge pressed against its limit is held there, else the others would count on its moving on.
            pressed = np.zeros(gradient.shape, dtype=bool)
            pressed[:, 6:] = ((best[:, 7:] <= limits[:, 0]) & (gradient[:, 6:] < 0)) | (
                (best[:, 7:] >= limits[:, 1]) & (gradient[:, 6:] > 0)
            )
            pull[pressed] = 0.0
            free = ~pressed
            damped *= free[:, :, None] & free[:, None, :]
            damped += pressed[:, :, None] * np.eye(6 + n)
        step = np.clip(np.linalg.solve(damped, pull[..., None])[..., 0], -0.5, 0.5)
        trial = best.copy()
        trial[:, :3] += step[:, :3]
        trial[:, 3:7] = rot.normalize(rot.multiply(rot.from_rotvec(step[:, 3:6]), trial[:, 3:7]))
        trial[:, 7:] += step[:, 6:]
        if limits is not None:
            trial[:, 7:] = np.clip(trial[:, 7:], limits[:, 0], limits[:, 1])
    last = _cost(skeleton, trial, targets) + stay**2 * np.sum((trial - start)[:, 7:] ** 2, axis=1)
    return np.where((last < cost)[:, None], trial, best)


def _normal_equations(
    skeleton: Skeleton, qpos: Array, start: Array, targets: Targets, stay: float
) -> tuple[Array, Array, Array]:
    """Gauss-Newton's matrix ``[T, 6 + D, 6 + D]``, right side ``[T, 6 + D]`` and the cost ``[T]`` (m^2) at ``qpos``."""
    moves, n, frames = _moves(skeleton), skeleton.n_dofs, len(qpos)
    w_p, w_o = targets.position_weight[:, None], targets.orientation_weight[:, None]
    k, m = len(targets.point_joint), len(targets.frame_joint)
    positions, quats = forward_kinematics(skeleton, qpos)
    points = positions[:, targets.point_joint] + rot.rotate(quats[:, targets.point_joint], targets.point_offset[None])
    axes = _hinge_axes(skeleton, qpos, quats)
    origins = positions[:, skeleton.dof_joint]
    jacobian = np.zeros((frames, 3 * (k + m), 6 + n))
    arm = points[:, :, None] - origins[:, None]
    turn = np.cross(np.broadcast_to(axes[:, None], arm.shape), arm) * moves[targets.point_joint][None, :, :, None]
    jacobian[:, : 3 * k, 6:] = (turn * w_p[None, :, None]).transpose(0, 1, 3, 2).reshape(frames, 3 * k, n)
    eye = np.eye(3)
    jacobian[:, : 3 * k, :3] = (eye[None] * w_p[..., None]).reshape(3 * k, 3)
    arm = points - positions[:, :1]
    # d(point)/d(world rotation vector of the root) = -[arm]x
    cross = np.zeros((frames, k, 3, 3))
    cross[..., 0, 1], cross[..., 0, 2] = arm[..., 2], -arm[..., 1]
    cross[..., 1, 0], cross[..., 1, 2] = -arm[..., 2], arm[..., 0]
    cross[..., 2, 0], cross[..., 2, 1] = arm[..., 1], -arm[..., 0]
    jacobian[:, : 3 * k, 3:6] = (cross * w_p[None, ..., None]).reshape(frames, 3 * k, 3)
    spin = axes[:, None] * moves[targets.frame_joint][None, :, :, None]
    jacobian[:, 3 * k :, 6:] = (spin * w_o[None, :, None]).transpose(0, 1, 3, 2).reshape(frames, 3 * m, n)
    jacobian[:, 3 * k :, 3:6] = (eye[None] * w_o[..., None]).reshape(3 * m, 3)
    off = rot.multiply(targets.orientations, rot.conjugate(quats[:, targets.frame_joint]))
    residual = np.concatenate(
        [((targets.positions - points) * w_p).reshape(frames, -1), (rot.to_rotvec(off) * w_o).reshape(frames, -1)],
        axis=1,
    )
    moved = start[:, 7:] - qpos[:, 7:]
    normal = jacobian.transpose(0, 2, 1) @ jacobian
    normal[:, np.arange(6, 6 + n), np.arange(6, 6 + n)] += stay**2
    gradient = np.einsum("tri,tr->ti", jacobian, residual)
    gradient[:, 6:] += stay**2 * moved
    return normal, gradient, np.sum(residual**2, axis=1) + stay**2 * np.sum(moved**2, axis=1)
