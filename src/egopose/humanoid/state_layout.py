"""Where each part of the humanoid state z stands (Yuan & Kitani 2019, section 3, "State").

z, in order: root height 1, de-headed root quaternion 4, D joint angles, root linear velocity in the heading frame 3,
root angular velocity in the root frame 3, D joint velocities. A *pose* is z without the joint velocities.
"""

from __future__ import annotations

from dataclasses import dataclass

_ROOT_POSE, _ROOT_VELOCITY = 1 + 4, 3 + 3
_ROOT = _ROOT_POSE + _ROOT_VELOCITY


@dataclass(frozen=True)
class StateLayout:
    """Slices of the last axis of z.

    Args:
        dofs: D, the degrees of freedom of the joints.

    Raises:
        ValueError: D is negative.
    """

    dofs: int

    def __post_init__(self) -> None:
        if self.dofs < 0:
            raise ValueError(f"a body cannot have {self.dofs} degrees of freedom")

    @classmethod
    def of_size(cls, size: int) -> StateLayout:
        """The layout of states z of ``size`` numbers.

        Raises:
            ValueError: no body has such a state.
        """
        dofs, odd = divmod(size - _ROOT, 2)
        if odd or dofs < 0:
            raise ValueError(f"a state has {_ROOT} + 2 x degrees of freedom, got {size}")
        return cls(dofs)

    @classmethod
    def of_pose_size(cls, size: int) -> StateLayout:
        """The layout of states whose poses have ``size`` numbers.

        Raises:
            ValueError: no body has such a pose.
        """
        if size < _ROOT:
            raise ValueError(f"a pose has {_ROOT} + degrees of freedom, got {size}")
        return cls(size - _ROOT)

    @property
    def size(self) -> int:
        """S, numbers of z."""
        return _ROOT + 2 * self.dofs

    @property
    def pose_size(self) -> int:
        """P, numbers of z without the joint velocities."""
        return _ROOT + self.dofs

    @property
    def root_height(self) -> slice:
        """1, m."""
        return slice(0, 1)

    @property
    def root_rotation(self) -> slice:
        """4, the de-headed unit quaternion: z is zero and w not negative."""
        return slice(1, _ROOT_POSE)

    @property
    def root_pose(self) -> slice:
        """5, height and rotation."""
        return slice(0, _ROOT_POSE)

    @property
    def joint_angles(self) -> slice:
        """D, rad."""
        return slice(_ROOT_POSE, _ROOT_POSE + self.dofs)

    @property
    def root_linear_velocity(self) -> slice:
        """3, m/s in the heading frame."""
        start = self.joint_angles.stop
        return slice(start, start + 3)

    @property
    def root_angular_velocity(self) -> slice:
        """3, rad/s in the root frame."""
        start = self.root_linear_velocity.stop
        return slice(start, start + 3)

    @property
    def root_velocity(self) -> slice:
        """6, linear and angular."""
        return slice(self.joint_angles.stop, self.pose_size)

    @property
    def joint_velocities(self) -> slice:
        """D, rad/s."""
        return slice(self.pose_size, self.size)

    @property
    def velocities(self) -> slice:
        """6 + D, of the root and the joints."""
        return slice(self.joint_angles.stop, self.size)

    @property
    def pose(self) -> slice:
        """P, all but the joint velocities."""
        return slice(0, self.pose_size)

    @property
    def rotation_and_angles(self) -> slice:
        """4 + D, root rotation and joint angles: what E_pose compares."""
        return slice(self.root_rotation.start, self.joint_angles.stop)
