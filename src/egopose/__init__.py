"""egopose: physically valid full-body motion from the video of a worn camera.

Conventions everywhere: SI units, radians, z up, quaternions ``wxyz``; time is the first axis of a clip, batch axes
lead. *Heading* of a quaternion: keep (w, z), zero (x, y), renormalise. *Heading frame*: the world frame turned by the
root's heading.
"""

from egopose.core.runtime import prepare_runtime

__version__ = "0.1.0"

# Before anything imports torch: its OpenMP threads read these settings when they start.
prepare_runtime()
