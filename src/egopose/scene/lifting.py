"""3D joints from 2D keypoints: a network that has seen motion capture through many virtual cameras.

Nine frames of keypoints go in, the middle frame's joints come out. Keypoints are taken relative to the middle of the
hips and to their own size, so a picture's place, scale and zoom do not matter. Depth is what a single picture leaves
open; where a pose network gives 3D landmarks as well, the mean of both is nearer than either.

Camera axes: x right, y down, z ahead. Metres come from the body height that the caller gives.
"""

from __future__ import annotations

from egopose.motion.rotations import Array
from egopose.scene.poses.track import PoseTrack

#: The joints that come out, in order: the default humanoid's.
JOINTS = (
    *("Hips", "Spine", "Spine1", "Spine2", "Spine3", "Neck", "Head"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
    *("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    *("RightUpLeg", "RightLeg", "RightFoot", "LeftUpLeg", "LeftLeg", "LeftFoot"),
)


def lift(track: PoseTrack, height: float = 1.75, focal: float | None = None) -> Array:
    """Joints ``[T, J, 3]`` m of :data:`JOINTS` in camera axes, relative to the middle of the hips.

    Args:
        track: 2D keypoints of any layout; its 3D landmarks count too where it has them in camera axes.
        height: m, of the body. 2D keypoints do not tell it.
        focal: px; None for a telephone's.

    Returns:
        NaN in frames that show too little of the person.

    Raises:
        InputError: the track has no pixels.
    """
    raise NotImplementedError
