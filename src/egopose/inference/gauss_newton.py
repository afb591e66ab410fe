"""What planners by Gauss-Newton share: offsets that are lines between knots, distances, and damped steps.

A window of frames is simulated with the policy in the loop: once as it is, and once for each knot of each joint's
offset. The differences are derivatives of all distances from the motion that is followed. The policy reacts to what
offsets do, so bodies stay up and distances change smoothly. Without it a contact that comes a frame later made
derivatives useless.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.humanoid.derivatives import state_difference
from egopose.humanoid.model import HumanoidModel
from egopose.motion.rotations import Array


@dataclass(frozen=True)
class DistanceWeights:
    """Weights of the squares of how far a body is from the motion that it follows, a frame.

    Args:
        bodies: 1/m^2, of the mean over bodies of the squared distance.
        feet: 1/m^2, on top, of each foot's, divided by the number of bodies.
        turn: 1/rad^2, of the root's turn.
        joints: 1/rad^2, of each joint.
        linear, angular: of the root's velocities, s^2/m^2 and s^2/rad^2.
        rates: s^2/rad^2, of each joint's velocity.
        acceleration: s^2/rad^2, of the change of each velocity from frame to frame; ten times it of the root's place.
    """

    bodies: float
    feet: float
    turn: float
    joints: float
    linear: float
    angular: float
    rates: float
    acceleration: float


class Distance:
    """Weighted differences between states, whose squares add up to a cost.

    Args:
        humanoid: whose states they are.
        weights: see :class:`DistanceWeights`.
        bodies: B, of which places are compared.
    """

    def __init__(self, humanoid: HumanoidModel, weights: DistanceWeights, bodies: int) -> None:
        w, joints = weights, np.ones(humanoid.mj_model.nu)
        self._of_state = np.sqrt(
            np.concatenate(
                [[0.0] * 3, [w.turn] * 3, w.joints * joints, [w.linear] * 3, [w.angular] * 3, w.rates * joints]
            )
        )
        share = np.full(bodies, w.bodies / bodies)
        share[list(humanoid.feet)] += w.feet / bodies
        self._of_bodies = np.sqrt(share)[:, None]
        faster = np.full(humanoid.mj_model.nv, w.acceleration)
        faster[:3] *= 10.0
        self._of_change = np.sqrt(faster)

    def of_state(self, qpos: Array, qvel: Array, wanted_qpos: Array, wanted_qvel: Array) -> Array:
        """``[..., 2 nv]`` of ``qpos [..., nq]`` and ``qvel [..., nv]``."""
        return self._of_state * state_difference(qpos, qvel, wanted_qpos, wanted_qvel)

    def of_bodies(self, places: Array, wanted: Array) -> Array:
        """``[..., B * 3]`` of ``places [..., B, 3]`` m."""
        apart = self._of_bodies * (places - wanted)
        return apart.reshape(*apart.shape[:-2], -1)

    def of_change(self, change: Array) -> Array:
        """``[..., nv]`` of the ``change [..., nv]`` of velocities in a frame, beside the one wanted."""
        return self._of_change * change


def knot_lines(length: int, spacing: int, changed: int) -> Array:
    """``[K, length]``: how far each knot in the first ``changed`` frames counts in each frame: lines between knots."""
    at = spacing * np.arange(1, -(-changed // spacing) + 1)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(1, length + 1)) / spacing)


def single_changes(lines: Array, size: int, difference: float) -> Array:
    """``[K * size, length, size]``: each of ``lines [K, length]`` in each of ``size`` joints, ``difference`` rad."""
    return difference * np.einsum("kl,ij->kilj", lines, np.eye(size)).reshape(-1, lines.shape[1], size)


def damped_steps(slopes: Array, residuals: Array, dampings: Sequence[float], reach: float) -> Array:
    """``[D, P]``: steps of Gauss-Newton under each damping, no parameter's longer than ``reach``.

    Args:
        slopes: ``[P, R]`` derivatives of the residuals.
        residuals: ``[R]``.
        dampings: added to the squares' matrix.
        reach: of each parameter.
    """
    values, vectors = np.linalg.eigh(slopes @ slopes.T)
    along = vectors.T @ (slopes @ residuals)
    steps = [-(vectors @ (along / (values + damping))) for damping in dampings]
    return np.clip(np.stack(steps), -reach, reach)


def steps_of(
    residuals: Array, sound: NDArray[np.bool_], difference: float, dampings: Sequence[float], reach: float
) -> Array:
    """``[D, P]``: :func:`damped_steps` by what came of each parameter alone; none where the window itself broke.

    Args:
        residuals: ``[1 + P, R]`` of the window as it is, and with each parameter ``difference`` larger.
        sound: ``[1 + P]`` whose physics did not break.
        difference: see ``residuals``.
        dampings, reach: see :func:`damped_steps`.
    """
    if not sound[0]:
        return np.zeros((len(dampings), len(residuals) - 1))
    slopes = np.where(sound[1:, None], residuals[1:] - residuals[0], 0.0) / difference
    return damped_steps(slopes, residuals[0], dampings, reach)


def check_steps(source: str, difference: float, reach: float, dampings: Sequence[float]) -> None:
    """Raises InputError: a value is not positive, or there is no damping."""
    for name, value in (("difference", difference), ("reach", reach)):
        if not value > 0:
            raise InputError(source, name, "must be positive, rad")
    if not dampings or min(dampings) <= 0:
        raise InputError(source, "dampings", "must be positive numbers, at least one")
