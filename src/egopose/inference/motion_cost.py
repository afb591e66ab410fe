"""What a simulated frame costs beside the frame of the reference that it should be: the terms of sampling.

The terms are those of Yu, Park & Lee 2021, section 4.3, as squares in place of exponentials: far from the reference an
exponential is flat, and sampling begins there. The reference's root may help (``root``); its weight may be zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.physics import BatchedPhysics
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array

TERMS = ("joints", "bodies", "turn", "rates", "contact", "root", "moved", "low", "tremble", "torque", "forbidden")
_FAR = 0.3  # m: a foot that is this far from where it should stand is as wrong as can be
_SLACK = 0.1  # m that the head may be below the reference's


@dataclass(frozen=True)
class CostWeights:
    """Weights of the terms.

    Args:
        joints: of the mean squared angle, 1/rad^2.
        bodies: of the mean squared distance of bodies, relative to the root, 1/m^2.
        turn: of the root's squared turn from the reference's, 1/rad^2.
        rates: of the mean squared difference of the joints' velocities, s^2/rad^2.
        contact: of each foot or hand that touches what it should not, or does not touch what it should.
        root: of the root's squared distance from the reference's, 1/m^2.
        moved: of the squared distance by which the reference was moved to stand on a world's boxes, 1/m^2.
        low: of metres that the head is too low.
        tremble: of the mean squared acceleration, s^4/rad^2.
        torque: of the mean squared torque, in shares of the limits.
        forbidden: of a body other than feet and hands that touches something, unless the scene says so.
    """

    joints: float
    bodies: float
    turn: float
    rates: float
    contact: float
    root: float
    moved: float
    low: float
    tremble: float
    torque: float
    forbidden: float


class MotionCost:
    """Costs of many bodies beside one reference.

    Args:
        humanoid: with contact sensors on every body.
        reference: body states ``[T]`` of :func:`egopose.data.reference.reference_states`, as arrays.
        wanted: ``[T, B, 1 + K]`` of :func:`egopose.scene.clip.wanted_contacts`.
        trust: ``[T]`` how far each frame of the reference is to be believed, 0 to 1.
        weights: see :class:`CostWeights`.
    """

    def __init__(
        self,
        humanoid: HumanoidModel,
        reference: Mapping[str, Array],
        wanted: NDArray[np.bool_],
        trust: Array,
        weights: CostWeights,
    ) -> None:
        self._reference, self._wanted, self._trust = reference, wanted, trust
        self._weights = np.array([getattr(weights, term) for term in TERMS])
        self._limits, self._head, self._dt = humanoid.torque_limit, humanoid.head, humanoid.control_dt
        names = humanoid.skeleton.names
        self._ends = np.array([i for i in humanoid.end_effectors if i != humanoid.head])
        self._others = np.array([i for i in range(len(names)) if i not in self._ends])
        # Hands that rest on nothing may touch what they like: only feet, and hands with a contact, are judged.
        feet = set(humanoid.feet)
        self._judged = np.array([i for i in self._ends if i in feet or wanted[:, i].any()])

    def __call__(self, frame: int, physics: BatchedPhysics, before: Array, moves: Array) -> Array:
        """``[N, C]`` weighted :data:`TERMS` of the worlds of ``physics``.

        Args:
            frame: that they should be in.
            physics: with contacts and torques.
            before: ``[N, nv]`` velocities a frame ago.
            moves: ``[N, T, 3]`` m: how far the reference is moved in each world.
        """
        reference, trust = self._reference, self._trust[frame]
        body, qpos, qvel = physics.body_state(), physics.qpos, physics.qvel
        move, places = moves[:, frame], body["xpos"]
        wanted_places = reference["xpos"][frame] + move[:, None]
        touching = np.concatenate([physics.floor_contacts[..., None], physics.box_contacts], axis=-1)
        away = (places - places[:, :1]) - (reference["xpos"][frame] - reference["xpos"][frame, 0])
        turn = rot.to_rotvec(
            rot.multiply(rot.conjugate(np.tile(reference["qpos"][frame, 3:7], (len(qpos), 1))), qpos[:, 3:7])
        )
        head = wanted_places[:, self._head, 2] - places[:, self._head, 2]
        terms = (
            trust * ((qpos[:, 7:] - reference["qpos"][frame, 7:]) ** 2).mean(axis=1),
            trust * (away**2).sum(axis=2).mean(axis=1),
            trust * (turn**2).sum(axis=1),
            trust * ((qvel[:, 6:] - reference["qvel"][frame, 6:]) ** 2).mean(axis=1),
            self._contacts(frame, touching, places, wanted_places),
            trust * ((qpos[:, :3] - reference["qpos"][frame, :3] - move) ** 2).sum(axis=1),
            trust * (move**2).sum(axis=1),
            np.maximum(head - _SLACK, 0.0),
            (((qvel - before) / self._dt) ** 2).mean(axis=1),
            ((physics.torques / self._limits) ** 2).mean(axis=1),
            (touching[:, self._others] & ~self._wanted[frame, self._others]).any(axis=(1, 2)).astype(float),
        )
        return np.stack(terms, axis=1) * self._weights

    def _contacts(self, frame: int, touching: NDArray[np.bool_], places: Array, wanted_places: Array) -> Array:
        """``[N]``: feet and hands that are wrong about what they touch; half for one that is near its place."""
        wanted = self._wanted[frame, self._judged]
        touches, should = touching[:, self._judged], wanted.any(axis=1)
        right = (touches & wanted).any(axis=2)
        wrong = (touches & ~wanted).any(axis=2)
        far = np.linalg.norm(places[:, self._judged] - wanted_places[:, self._judged], axis=2)
        missing = should & ~right
        return np.asarray(
            (wrong | missing).sum(axis=1) * 0.5 + (missing * np.minimum(far / _FAR, 1.0)).sum(axis=1) * 0.5
        )
