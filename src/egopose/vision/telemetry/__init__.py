"""What a camera measured while it filmed: how it turned, where down is, how its picture was turned and cropped.

Vectors are in camera axes (x right, y down, z ahead) and times are seconds of the video, whatever the file has.
"""

from __future__ import annotations

from egopose.vision.telemetry.camera import camera_from_telemetry, require_undoable
from egopose.vision.telemetry.frames import angular_velocity_at, down_at, gyroscope_bias, image_rotation
from egopose.vision.telemetry.gpmf import read_telemetry
from egopose.vision.telemetry.samples import Samples, Telemetry, Trajectory
from egopose.vision.telemetry.tables import ARIA_RGB_MOUNT, read_aria_trajectory, read_imu_csv
from egopose.vision.telemetry.writer import write_gpmf_mp4

__all__ = [
    "ARIA_RGB_MOUNT",
    "Samples",
    "Telemetry",
    "Trajectory",
    "angular_velocity_at",
    "camera_from_telemetry",
    "down_at",
    "gyroscope_bias",
    "image_rotation",
    "read_aria_trajectory",
    "read_imu_csv",
    "read_telemetry",
    "require_undoable",
    "write_gpmf_mp4",
]
