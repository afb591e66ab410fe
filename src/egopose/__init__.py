"""egopose: physically valid full-body motion from the video of a worn camera.

Conventions everywhere: SI units, radians, z up, quaternions ``wxyz``; time is the first axis of a clip, batch axes
lead. *Heading* of a quaternion: keep (w, z), zero (x, y), renormalise. *Heading frame*: the world frame turned by the
root's heading.
"""

__version__ = "0.1.0"
