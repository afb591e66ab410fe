"""Inverse kinematics of a whole clip at once: points with noise, and a body that does not accelerate without end.

Each frame's normal equations come from :mod:`egopose.motion.inverse_kinematics`. Second differences in time couple the
frames, so a clip is one banded linear system a step. A frame that sees nothing is bridged by its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from egopose.motion import rotations as rot
from egopose.motion.inverse_kinematics import Targets, moved, normal_equations
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton

#: A clip whose cost falls by a smaller share than this in a step has settled.
_SETTLED = 1e-3


@dataclass(frozen=True)
class Smoothness:
    """What an acceleration costs, against a metre between a point and its target.

    The best values are the noise of a point (m) over the usual acceleration of a body.

    Args:
        hinges: m per rad/s^2, of the hinges and of the root's rotation.
        root: m per m/s^2, of the root's position.
    """

    hinges: float
    root: float


#: For points with 30 mm of noise an axis. Of six pairs tried on mocap it gave the least error; twice as much flattens.
NOISY_KEYPOINTS = Smoothness(hinges=0.001, root=0.003)


def solve_smooth(
    skeleton: Skeleton,
    start: Array,
    targets: Targets,
    fps: float,
    smoothness: Smoothness = NOISY_KEYPOINTS,
    limits: Array | None = None,
    iterations: int = 12,
    stay: float = 1e-3,
) -> Array:
    """Coordinates whose points come near the targets while they change smoothly: damped Gauss-Newton over all frames.

    Args:
        skeleton: hinges only.
        start: ``[T, nq]``; a solution of :func:`egopose.motion.inverse_kinematics.solve` frame by frame.
        targets: see :class:`Targets`; a point of weight 0 is unseen.
        fps: frames per second.
        smoothness: what accelerations cost.
        limits: ``[D, 2]`` rad; steps are projected onto them.
        iterations: Gauss-Newton steps.
        stay: m per rad: weight of staying at ``start``; 0 lets unseen frames go where their neighbours lead.

    Returns:
        ``[T, nq]``.

    Raises:
        ValueError: ``fps`` is not positive.
    """
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be positive, got {fps}")
    if len(start) < 3:
        return start.copy()
    weight = np.full(skeleton.n_dofs + 6, smoothness.hinges * fps**2)
    weight[:3] = smoothness.root * fps**2
    qpos, damping = start.copy(), 1e-6
    normal, gradient, cost = _coupled(skeleton, qpos, start, targets, stay, weight)
    for _ in range(iterations):
        trial = moved(qpos, _banded_step(normal, gradient, weight, damping), limits)
        new = _coupled(skeleton, trial, start, targets, stay, weight)
        if new[2] >= cost:
            damping *= 30
            continue
        settled = cost - new[2] < _SETTLED * cost
        qpos, (normal, gradient, cost), damping = trial, new, max(damping / 10, 1e-6)
        if settled:
            break
    return qpos


def second_differences(qpos: Array) -> Array:
    """``[T - 2, 6 + D]``: how each inner frame's change differs from the one before it (m, rad).

    The root's rotation counts as rotation vectors in the world.
    """
    out = np.empty((len(qpos) - 2, qpos.shape[1] - 1))
    out[:, :3] = np.diff(qpos[:, :3], n=2, axis=0)
    turns = rot.to_rotvec(rot.multiply(qpos[1:, 3:7], rot.conjugate(qpos[:-1, 3:7])))
    out[:, 3:6] = np.diff(turns, axis=0)
    out[:, 6:] = np.diff(qpos[:, 7:], n=2, axis=0)
    return out


def _coupled(
    skeleton: Skeleton, qpos: Array, start: Array, targets: Targets, stay: float, weight: Array
) -> tuple[Array, Array, float]:
    """Every frame's own matrix ``[T, N, N]``, the whole right side ``[T, N]`` and the whole cost (m^2)."""
    chunks = [
        normal_equations(skeleton, qpos[i : i + 512], start[i : i + 512], targets.at(slice(i, i + 512)), stay)
        for i in range(0, len(qpos), 512)
    ]
    normal, gradient, costs = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    bend = weight**2 * second_differences(qpos)
    gradient[:-2] -= bend
    gradient[1:-1] += 2 * bend
    gradient[2:] -= bend
    return normal, gradient, float(costs.sum() + np.sum((bend / weight) ** 2))


def _banded_step(normal: Array, gradient: Array, weight: Array, damping: float) -> Array:
    """``[T, N]``: the step that the frames' matrices and the second differences between them give."""
    frames, size = gradient.shape
    band = np.zeros((2 * size + 1, frames, size))
    # Row `2 size - d` of the upper band holds the d-th diagonal; a frame's own block reaches d = size - 1.
    for d in range(size):
        band[2 * size - d, :, d:] = np.diagonal(normal, d, axis1=1, axis2=2)
    second = np.zeros((frames, 3))
    for row, column, value in [(0, 0, 1.0), (1, 0, 4.0), (2, 0, 1.0), (1, 1, -2.0), (2, 1, -2.0), (2, 2, 1.0)]:
        second[row : frames - 2 + row, column] += value
    for apart in range(3):
        band[2 * size - apart * size] += second[:, apart, None] * weight**2
    band[2 * size] += damping
    return solveh_banded(band.reshape(2 * size + 1, -1), gradient.ravel(), check_finite=False).reshape(frames, size)
