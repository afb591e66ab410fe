"""The noun everything carries: a skeleton in motion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Slerp

from egopose.motion import rotations as rot
from egopose.motion.ground_reaction import GroundReaction
from egopose.motion.kinematics import forward_kinematics
from egopose.motion.rotations import Array
from egopose.motion.skeleton import Skeleton


@dataclass(frozen=True)
class Motion:
    """A clip: z up, metres, radians, quaternions wxyz.

    Args:
        skeleton: the tree the coordinates belong to.
        qpos: ``[T, nq]``.
        fps: frames per second.
        name: of the take.
        contacts: ``[T, k]`` booleans per contact point, or None; ``contact_names`` says which.
        torques: ``[T, nv - 6]`` N m per hinge, or None.
        ground_reaction: forces of the ground, or None.
        confidence: ``[T]`` how sure an estimate is of each frame, 1 being as sure as usual, or None.
        meta: where it comes from (JSON-like values only): source, units, up axis, licence.

    Raises:
        ValueError: shapes that do not agree, non-finite values, a frame rate that is not positive.
    """

    skeleton: Skeleton
    qpos: Array
    fps: float
    name: str = ""
    contacts: np.ndarray | None = None
    contact_names: tuple[str, ...] = ()
    torques: Array | None = None
    ground_reaction: GroundReaction | None = None
    confidence: Array | None = None
    meta: dict[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        qpos = np.asarray(self.qpos, dtype=np.float64)
        object.__setattr__(self, "qpos", qpos)
        if qpos.ndim != 2 or qpos.shape[1] != self.skeleton.nq:
            raise ValueError(f"qpos must be [T, {self.skeleton.nq}] for this skeleton, got {list(qpos.shape)}")
        if len(qpos) == 0:
            raise ValueError("a motion needs at least one frame")
        if not np.isfinite(qpos).all():
            raise ValueError(f"qpos is not finite at frame {int(np.argwhere(~np.isfinite(qpos))[0, 0])}")
        if not self.fps > 0:
            raise ValueError(f"fps must be positive, got {self.fps}")
        for label in ("contacts", "torques", "ground_reaction", "confidence"):
            extra = getattr(self, label)
            if extra is not None and len(extra) != len(qpos):
                raise ValueError(f"{label} have {len(extra)} frames, qpos has {len(qpos)}")

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (len(self) - 1) / self.fps

    def forward_kinematics(self) -> tuple[Array, Array]:
        """World positions ``[T, J, 3]`` and quaternions ``[T, J, 4]`` of all joints."""
        return forward_kinematics(self.skeleton, self.qpos)

    def qvel(self) -> Array:
        """``[T, nv]`` velocities, see :func:`finite_difference`."""
        return finite_difference(self.qpos, self.fps)

    def slice(self, start: int, stop: int) -> Motion:
        """Frames ``start`` to ``stop`` (exclusive)."""
        part = slice(start, stop)
        return replace(
            self,
            qpos=self.qpos[part],
            contacts=None if self.contacts is None else self.contacts[part],
            torques=None if self.torques is None else self.torques[part],
            ground_reaction=None if self.ground_reaction is None else self.ground_reaction.at(part),
            confidence=None if self.confidence is None else self.confidence[part],
        )

    def resample(self, fps: float) -> Motion:
        """The same motion at another rate, from the first frame on: slerp for the root, linear for the rest.

        Contacts, confidence and forces of the ground take the nearest frame. The last sample is the last that lies
        inside the clip.
        """
        if abs(fps - self.fps) < 1e-9 or len(self) == 1:
            return replace(self, fps=fps)
        count = int(np.floor(self.duration * fps + 1e-6)) + 1
        at = np.minimum(np.arange(count) / fps * self.fps, len(self) - 1)
        low = np.minimum(np.floor(at).astype(int), len(self) - 2)
        weight = (at - low)[:, None]
        # Hinge values are angles of one branch in time; unwrapping keeps a +-pi jump from being interpolated through.
        hinge = np.array([d.kind == "hinge" for j in self.skeleton.joints for d in j.dofs], dtype=bool)
        joints = self.qpos[:, 7:].copy()
        joints[:, hinge] = np.unwrap(joints[:, hinge], axis=0)
        linear = np.concatenate([self.qpos[:, :3], joints], axis=1)
        values = (1 - weight) * linear[low] + weight * linear[low + 1]
        quat = rot.from_scipy(Slerp(np.arange(len(self)), rot.to_scipy(self.qpos[:, 3:7]))(at), (count,))
        qpos = np.concatenate([values[:, :3], rot.continuous(quat), values[:, 3:]], axis=1)
        nearest = np.round(at).astype(int)
        return replace(
            self,
            qpos=qpos,
            fps=fps,
            contacts=None if self.contacts is None else self.contacts[nearest],
            torques=None if self.torques is None else (1 - weight) * self.torques[low] + weight * self.torques[low + 1],
            ground_reaction=None if self.ground_reaction is None else self.ground_reaction.at(nearest),
            confidence=None if self.confidence is None else self.confidence[nearest],
        )


def finite_difference(qpos: Array, fps: float) -> Array:
    """MuJoCo velocities by forward differences on the group.

    Args:
        qpos: ``[T, nq]``.
        fps: frames per second.

    Returns:
        ``[T, nv]``: root linear (world, m/s), root angular (root frame, rad/s), joints (rad/s). The last frame repeats
        the one before it; a single frame has zero velocity.
    """
    qvel = np.zeros((len(qpos), qpos.shape[1] - 1))
    if len(qpos) < 2:
        return qvel
    qvel[:-1, :3] = np.diff(qpos[:, :3], axis=0) * fps
    relative = rot.multiply(rot.conjugate(qpos[:-1, 3:7]), qpos[1:, 3:7])
    qvel[:-1, 3:6] = rot.to_rotvec(relative) * fps
    qvel[:-1, 6:] = np.diff(qpos[:, 7:], axis=0) * fps
    qvel[-1] = qvel[-2]
    return qvel
