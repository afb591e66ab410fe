"""A camera's motion that is known beforehand: written, read, and refused where it cannot be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egopose.core.errors import InputError
from egopose.scene.camera import CameraTrack
from egopose.scene.camera_file import given_camera, load_camera, save_camera


def panned(frames: int = 5) -> CameraTrack:
    to_first = np.tile(np.eye(3), (frames, 1, 1))
    to_first[:, 0, 2] = np.arange(frames) * 7.0
    return CameraTrack(to_first, np.arange(frames) == 2, np.linspace(1.0, 0.8, frames), "homography")


def test_what_is_written_is_read(tmp_path: Path) -> None:
    save_camera(panned(), tmp_path / "camera.npz")
    camera = given_camera(tmp_path / "camera.npz", 5)
    np.testing.assert_array_equal(camera.to_first, panned().to_first)
    np.testing.assert_array_equal(camera.degenerate, panned().degenerate)
    np.testing.assert_array_equal(camera.alike, panned().alike)
    assert camera.kind == "homography"


def test_another_number_of_frames_is_told(tmp_path: Path) -> None:
    save_camera(panned(), tmp_path / "camera.npz")
    with pytest.raises(InputError, match="has 5 frames; there are poses of 6"):
        given_camera(tmp_path / "camera.npz", 6)


def test_no_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        given_camera(tmp_path / "camera.npz", 6)


@pytest.mark.parametrize(
    ("name", "value", "cause"),
    [
        ("to_first", None, "is missing"),
        ("kind", None, "is missing"),
        ("to_first", np.zeros((5, 2, 3)), "must be"),
        ("to_first", np.full((5, 3, 3), np.nan), "finite"),
        ("alike", np.ones(4), "must be"),
        ("degenerate", np.ones(6, bool), "must be"),
        ("kind", np.frombuffer(b"drone", np.uint8), "none of"),
    ],
)
def test_what_is_no_motion_of_a_camera_is_refused(
    tmp_path: Path, name: str, value: np.ndarray | None, cause: str
) -> None:
    camera = panned()
    arrays = {"to_first": camera.to_first, "degenerate": camera.degenerate, "alike": camera.alike}
    arrays |= {"kind": np.frombuffer(b"similarity", np.uint8)}
    if value is None:
        del arrays[name]
    else:
        arrays[name] = value
    np.savez(tmp_path / "camera.npz", **arrays)
    with pytest.raises(InputError, match=cause) as caught:
        load_camera(tmp_path / "camera.npz")
    assert caught.value.field == name
