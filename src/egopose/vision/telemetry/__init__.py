"""What a camera measured while it filmed: how it turned, where down is, how its picture was turned and cropped.

Vectors are in camera axes (x right, y down, z ahead) and times are seconds of the video, whatever the file has.
"""

from __future__ import annotations

from egopose.vision.telemetry.samples import Samples, Telemetry, Trajectory
from egopose.vision.telemetry.writer import write_gpmf_mp4

__all__ = ["Samples", "Telemetry", "Trajectory", "write_gpmf_mp4"]
