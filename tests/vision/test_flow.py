"""Optical flow against known image motion, and independence of resolution, threads and batches."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.vision.features import extract_flow
from egopose.vision.flow import FlowConfig, flow_image, flow_of_frames, grey_square
from egopose.vision.video import write_video

CONFIG = FlowConfig(preset="ultrafast", working_size=128, stored_size=32, workers=1)


def texture(size: int = 512) -> np.ndarray:
    """A picture with detail at every scale."""
    rng = np.random.default_rng(0)
    layers = [cv2.resize(rng.random((n, n, 3)), (size, size), interpolation=cv2.INTER_CUBIC) for n in (8, 24, 72)]
    picture = sum(layers)
    return (np.clip((picture - picture.min()) / np.ptp(picture), 0, 1) * 255).astype(np.uint8)


def shifted(picture: np.ndarray, size: int, across: float, down: float) -> np.ndarray:
    """A window of ``size`` on the picture, its content moved by (across, down) pixels."""
    move = np.array([[1.0, 0.0, across - 128], [0.0, 1.0, down - 128]])
    return cv2.warpAffine(picture, move, (size, size), flags=cv2.INTER_CUBIC)


@settings(max_examples=20, deadline=None)
@given(across=st.floats(-5, 5), down=st.floats(-5, 5))
def test_flow_of_a_shift_is_the_shift(across: float, down: float) -> None:
    picture = texture()
    flow = list(flow_of_frames([shifted(picture, 128, 0, 0), shifted(picture, 128, across, down)], CONFIG))
    assert not flow[0].any()
    inner = flow[1][:, 6:-6, 6:-6].astype(np.float64) * 128
    np.testing.assert_allclose(np.median(inner, axis=(1, 2)), [across, down], atol=0.25)


def test_flow_does_not_depend_on_the_resolution() -> None:
    picture = texture()
    pair = [shifted(picture, 256, 0, 0), shifted(picture, 256, 6, -4)]
    small = FlowConfig("medium", 128, 32, 1)
    large = FlowConfig("medium", 256, 32, 1)
    a, b = (list(flow_of_frames(pair, c))[1].astype(np.float64)[:, 4:-4, 4:-4] for c in (small, large))
    np.testing.assert_allclose(np.median(a, axis=(1, 2)), [6 / 256, -4 / 256], atol=2e-3)
    np.testing.assert_allclose(np.median(a, axis=(1, 2)), np.median(b, axis=(1, 2)), atol=2e-3)


def test_threads_change_nothing(tmp_path: Path) -> None:
    picture = texture()
    path = tmp_path / "pan.mp4"
    write_video(path, [shifted(picture, 128, 2 * i, np.sin(i)) for i in range(20)], 30)
    one = extract_flow(path, CONFIG)
    two = extract_flow(path, {"preset": "ultrafast", "working_size": 128, "stored_size": 32, "workers": 3})
    assert one.shape == (20, 2, 32, 32)
    assert one.dtype == np.float16
    assert np.array_equal(one, two)
    assert not one[0].any()
    assert np.median(one[1:, 0].astype(float)) * 128 == pytest.approx(2, abs=0.3)


def test_stored_flow_is_the_area_mean() -> None:
    picture = texture()
    pair = [shifted(picture, 128, 0, 0), shifted(picture, 128, 3, 1)]
    full = list(flow_of_frames(pair, FlowConfig("fast", 128, 128, 1)))[1].astype(np.float64)
    small = list(flow_of_frames(pair, FlowConfig("fast", 128, 16, 1)))[1].astype(np.float64)
    np.testing.assert_allclose(small, full.reshape(2, 16, 8, 16, 8).mean((2, 4)), atol=1e-4)


def test_a_wide_frame_is_cropped_to_its_middle() -> None:
    frame = np.zeros((60, 100, 3), np.uint8)
    frame[:, 20:80] = 255
    assert grey_square(frame, 32).min() == 255
    assert grey_square(frame.transpose(1, 0, 2), 32).shape == (32, 32)


@pytest.mark.parametrize(
    ("field", "value"), [("preset", "best"), ("stored_size", 33), ("working_size", 8), ("workers", 0)]
)
def test_bad_settings_are_refused(field: str, value: object) -> None:
    settings_ = {"preset": "fast", "working_size": 128, "stored_size": 32, "workers": 1, field: value}
    with pytest.raises(InputError, match=field):
        FlowConfig(**settings_)  # type: ignore[arg-type]


def test_flow_picture_shows_direction_by_hue() -> None:
    right, left = np.zeros((2, 8, 8)), np.zeros((2, 8, 8))
    right[0], left[0] = 0.05, -0.05
    assert not np.array_equal(flow_image(right), flow_image(left))
    assert not flow_image(np.zeros((2, 8, 8))).any()
