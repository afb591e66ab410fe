"""Inverse kinematics of a :class:`Skeleton`, all frames at once: damped Gauss-Newton on positions and orientations."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
        position_weight: ``[K]``, or ``[T, K]`` where frames differ; 1 for a point that counts fully, 0 for one unseen.
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

    def at(self, frames: slice | np.ndarray) -> Targets:
        """Those of some frames."""
        shared = self.position_weight.ndim == 1
        return replace(
            self,
            positions=self.positions[frames],
            position_weight=self.position_weight if shared else self.position_weight[frames],
            orientations=self.orientations[frames],
        )


@lru_cache(maxsize=32)
def _moves(skeleton: Skeleton) -> np.ndarray:
    """``[J, D]``: does degree of freedom d move joint j?"""
    moves = np.zeros((len(skeleton), skeleton.n_dofs), dtype=bool)
    for j in range(len(skeleton)):
        if j:
            moves[j] = moves[skeleton.parents[j]]
        moves[j, skeleton.dof_slices[j]] = True
    return moves


def _kinematics(skeleton: Skeleton, qpos: Array) -> tuple[Array, Array, Array]:
    """:func:`forward_kinematics` and the world axes ``[T, D, 3]`` of all degrees of freedom (hinges only)."""
    axes = np.array([dof.axis for joint in skeleton.joints for dof in joint.dofs])
    turns = rot.from_axis_angle(axes, qpos[:, 7:])
    positions, quats = np.empty((len(qpos), len(skeleton), 3)), np.empty((len(qpos), len(skeleton), 4))
    world = np.empty((len(qpos), skeleton.n_dofs, 3))
    positions[:, 0], quats[:, 0] = qpos[:, :3], qpos[:, 3:7]
    for j, joint in enumerate(skeleton.joints[1:], start=1):
        frame = quats[:, joint.parent]
        positions[:, j] = positions[:, joint.parent] + rot.rotate(frame, np.array(joint.offset))
        for column in range(*skeleton.dof_slices[j].indices(skeleton.n_dofs)):
            world[:, column] = rot.rotate(frame, axes[column])
            frame = rot.multiply(frame, turns[:, column])
        quats[:, j] = frame
    return positions, quats, world


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
        _solve(skeleton, start[i : i + 512], targets.at(slice(i, i + 512)), limits, iterations, damping, stay)
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
        again = solve(skeleton, qpos[neighbour], targets.at(bad), limits)
        new_cost = _cost(skeleton, again, targets.at(bad))
        better = new_cost < cost[bad]
        qpos[bad[better]], cost[bad[better]] = again[better], new_cost[better]
    return qpos


#: A frame whose cost changes by a smaller share than this in a step has settled.
_SETTLED = 1e-4
#: Weighted root of the summed squared distances (m) above which a frame is tried again from its neighbours.
_STUCK = 0.05


def _cost(skeleton: Skeleton, qpos: Array, targets: Targets) -> Array:
    """``[T]`` weighted squared distance of all points and frames, m^2."""
    positions, quats = forward_kinematics(skeleton, qpos)
    points = positions[:, targets.point_joint] + rot.rotate(quats[:, targets.point_joint], targets.point_offset[None])
    off = rot.to_rotvec(rot.multiply(targets.orientations, rot.conjugate(quats[:, targets.frame_joint])))
    return np.sum(((targets.positions - points) * targets.position_weight[..., None]) ** 2, axis=(1, 2)) + np.sum(
        (off * targets.orientation_weight[:, None]) ** 2, axis=(1, 2)
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
    """One chunk of :func:`solve`; a frame that has settled takes no part in further steps."""
    best = start.copy()
    active = np.arange(len(start))
    normal, gradient, cost = normal_equations(skeleton, start, start, targets, stay)
    squared = np.full(len(start), damping**2)
    for _ in range(iterations):
        trial = _step(best[active], normal, gradient, squared, limits)
        here = targets.at(active)
        new_normal, new_gradient, new_cost = normal_equations(skeleton, trial, start[active], here, stay)
        # A full step from a nearly straight limb can throw it anywhere: a worse frame goes back and steps shorter.
        better = new_cost < cost
        gain = cost - new_cost
        settled = np.abs(gain) < _SETTLED * cost + 1e-12
        best[active[better]] = trial[better]
        normal[better], gradient[better], cost[better] = new_normal[better], new_gradient[better], new_cost[better]
        squared = np.where(better, np.maximum(squared / 10, damping**2), squared * 30)
        if settled.any():
            going = ~settled
            active, normal, gradient = active[going], normal[going], gradient[going]
            cost, squared = cost[going], squared[going]
        if not len(active):
            break
    return best


def _step(qpos: Array, normal: Array, gradient: Array, squared: Array, limits: Array | None) -> Array:
    """``qpos`` after a damped Gauss-Newton step, ``squared [T]`` being the damping's square."""
    size = gradient.shape[1]
    damped = normal.copy()
    diagonal = np.arange(size)
    damped[:, diagonal, diagonal] += squared[:, None]
    pull = gradient.copy()
    if limits is not None:
        # A hinge pressed against its limit is held there, else the others would count on its moving on.
        pressed = np.zeros(gradient.shape, dtype=bool)
        pressed[:, 6:] = ((qpos[:, 7:] <= limits[:, 0]) & (gradient[:, 6:] < 0)) | (
            (qpos[:, 7:] >= limits[:, 1]) & (gradient[:, 6:] > 0)
        )
        pull[pressed] = 0.0
        frames, held = np.nonzero(pressed)
        damped[frames, held, :] = 0.0
        damped[frames, :, held] = 0.0
        damped[frames, held, held] = 1.0
    step = np.linalg.solve(damped, pull[..., None])[..., 0]
    return moved(qpos, np.asarray(step, dtype=np.float64), limits)


def moved(qpos: Array, step: Array, limits: Array | None) -> Array:
    """``qpos [T, nq]`` after a step ``[T, 6 + D]`` in the columns of :func:`normal_equations`.

    No number steps by more than 0.5, and hinges stay within ``limits [D, 2]``.
    """
    step = np.clip(step, -0.5, 0.5)
    out = qpos.copy()
    out[:, :3] += step[:, :3]
    out[:, 3:7] = rot.normalize(rot.multiply(rot.from_rotvec(step[:, 3:6]), out[:, 3:7]))
    out[:, 7:] += step[:, 6:]
    if limits is not None:
        out[:, 7:] = np.clip(out[:, 7:], limits[:, 0], limits[:, 1])
    return out


def normal_equations(
    skeleton: Skeleton, qpos: Array, start: Array, targets: Targets, stay: float
) -> tuple[Array, Array, Array]:
    """Gauss-Newton's matrix ``[T, 6 + D, 6 + D]``, right side ``[T, 6 + D]`` and the cost ``[T]`` (m^2) at ``qpos``.

    The columns are the root's position (m), its rotation vector in the world (rad) and the hinges (rad). The other
    arguments are those of :func:`solve`.
    """
    n, frames = skeleton.n_dofs, len(qpos)
    w_p, w_o = targets.position_weight[..., None], targets.orientation_weight[:, None]
    positions, quats, axes = _kinematics(skeleton, qpos)
    points = positions[:, targets.point_joint] + rot.rotate(quats[:, targets.point_joint], targets.point_offset[None])
    off = rot.multiply(targets.orientations, rot.conjugate(quats[:, targets.frame_joint]))
    residual = np.concatenate(
        [((targets.positions - points) * w_p).reshape(frames, -1), (rot.to_rotvec(off) * w_o).reshape(frames, -1)],
        axis=1,
    )
    jacobian = _jacobian(skeleton, targets, positions, points, axes)
    away = start[:, 7:] - qpos[:, 7:]
    normal = jacobian.transpose(0, 2, 1) @ jacobian
    normal[:, np.arange(6, 6 + n), np.arange(6, 6 + n)] += stay**2
    gradient = (residual[:, None] @ jacobian)[:, 0]
    gradient[:, 6:] += stay**2 * away
    return normal, gradient, np.sum(residual**2, axis=1) + stay**2 * np.sum(away**2, axis=1)


def _jacobian(skeleton: Skeleton, targets: Targets, positions: Array, points: Array, axes: Array) -> Array:
    """``[T, 3 (K + M), 6 + D]``: the points' and the frames' weighted derivatives.

    Columns: the root's position, its world rotation vector, the hinges.
    """
    moves, n, frames = _moves(skeleton), skeleton.n_dofs, len(axes)
    k, m = len(targets.point_joint), len(targets.frame_joint)
    # The root turns about the world's axes at its own place, as three more hinges that move everything.
    turns = np.concatenate([np.broadcast_to(np.eye(3), (frames, 3, 3)), axes], axis=1)
    origins = np.concatenate([np.repeat(positions[:, :1], 3, axis=1), positions[:, skeleton.dof_joint]], axis=1)
    point_weight, frame_weight = np.ones((k, 3 + n)), np.ones((m, 3 + n))
    point_weight[:, 3:], frame_weight[:, 3:] = moves[targets.point_joint], moves[targets.frame_joint]
    # [K, 3 + D], or [T, K, 3 + D] where the frames' weights differ.
    point_weight = point_weight * targets.position_weight[..., None]
    frame_weight *= targets.orientation_weight[:, None]
    out = np.zeros((frames, k + m, 3, 6 + n))
    out[:, :k, :, :3] = np.eye(3) * targets.position_weight[..., None, None]
    x, y, z = (turns[:, None, :, i] for i in range(3))
    # axis x (point - origin) = axis x point + origin x axis: the second part is the same for every point.
    rest = np.cross(origins, turns)
    px, py, pz = (points[:, :, None, i] for i in range(3))
    for i, product in enumerate((y * pz - z * py, z * px - x * pz, x * py - y * px)):
        out[:, :k, i, 3:] = (product + rest[:, None, :, i]) * point_weight
        out[:, k:, i, 3:] = turns[:, None, :, i] * frame_weight
    return out.reshape(frames, 3 * (k + m), 6 + n)
