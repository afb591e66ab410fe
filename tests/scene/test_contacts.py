"""The contact network's inputs, what it sees at a clip's ends, and cameras against the pinhole's formula."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.seen_legs import legs, mirrored_legs
from hypothesis import given
from hypothesis import strategies as st

from egopose.scene.contacts import FEATURES, ContactNetwork, contact_features, mirrored_features
from egopose.scene.virtual_camera import KINDS, background_motion, draw_camera, project

SURE = np.ones((20, 7))


def parts(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places and movements ``[T, 7, 2]``."""
    return features[:, :14].reshape(-1, 7, 2), features[:, 14:28].reshape(-1, 7, 2)


def test_places_and_movements_are_in_leg_lengths() -> None:
    points = legs()
    features = contact_features(points, 0.5 * SURE)
    assert features.shape == (20, FEATURES)
    places, movements = parts(features)
    np.testing.assert_array_equal(places[:, 0], 0.0)
    bones = np.linalg.norm(points[:, [2, 3, 5, 6]] - points[:, [1, 2, 4, 5]], axis=-1).reshape(20, 2, 2).sum(axis=2)
    length = bones.max(axis=1)[3:18].mean()  # of the 15 frames around frame 10
    np.testing.assert_allclose(places[10], (points[10] - points[10, 0]) / length, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(movements[10], 10 * (points[11] - points[10]) / length, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(movements[-1], 0.0)
    np.testing.assert_array_equal(features[:, 28:], [[0.5] * 7 + [1.0]] * 20)
    # A joint that jumps across the picture is cut.
    points[5, 3] += 1e6
    assert np.abs(parts(contact_features(points, SURE))[1]).max() <= 2.0


@given(shift=st.tuples(*[st.floats(-1e3, 1e3)] * 2), scale=st.floats(0.01, 1e3))
def test_place_and_unit_do_not_matter(shift: tuple[float, float], scale: float) -> None:
    points, sure = legs(12), np.full((12, 7), 0.5)
    np.testing.assert_allclose(
        contact_features(points * scale + shift, sure), contact_features(points, sure), atol=1e-3 / min(scale, 1.0)
    )


def test_a_camera_that_is_known_is_undone() -> None:
    """A camera that turns, rolls and zooms gives the movements of the still one, in its own axes and size."""
    frames = 30
    points, random = legs(frames, 3), np.random.default_rng(1)
    angle, zoom = 0.02 * random.normal(size=frames).cumsum(), np.exp(0.03 * random.normal(size=frames).cumsum())
    camera = np.tile(np.eye(3), (frames, 1, 1))
    camera[:, 0, 0] = camera[:, 1, 1] = zoom * np.cos(angle)
    camera[:, 1, 0], camera[:, 0, 1] = zoom * np.sin(angle), -zoom * np.sin(angle)
    camera[:, :2, 2] = random.normal(size=(frames, 2)).cumsum(axis=0)
    homogeneous = np.concatenate([points, np.ones((frames, 7, 1))], axis=-1)
    seen = np.einsum("tij,tkj->tki", np.linalg.inv(camera), homogeneous)[..., :2]
    sure = np.ones((frames, 7))
    undone, still, as_seen = (
        parts(contact_features(p, sure, c)) for p, c in ((seen, camera), (points, None), (seen, None))
    )
    # Against the place of a joint in the same frame, size and roll cancel.
    for t in (0, 10, 20):
        rows = [np.linalg.norm(m[t], axis=-1) / np.linalg.norm(p[t, 3]) for p, m in (undone, still, as_seen)]
        np.testing.assert_allclose(rows[0], rows[1], rtol=1e-3)
        assert np.abs(rows[2] / rows[1] - 1).max() > 0.1


def test_unseen_joints_are_interpolated() -> None:
    points, sure = legs(), SURE.copy()
    points[8:10, 3], sure[8:10, 3] = np.nan, 0.0
    features = contact_features(points, sure)
    between = points.copy()
    between[8:10, 3] = points[7, 3] + np.array([[1 / 3], [2 / 3]]) * (points[10, 3] - points[7, 3])
    np.testing.assert_allclose(features[:, :28], contact_features(between, SURE)[:, :28], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(features[8:10, 31], 0.0)
    sure[:, 3] = 0.0
    assert np.isfinite(contact_features(points, sure)).all()
    assert np.isfinite(contact_features(points, 0 * sure)).all()
    sure[8, 3] = 0.1
    with pytest.raises(ValueError, match="finite"):
        contact_features(points, sure)
    with pytest.raises(ValueError, match=r"T, 7, 2"):
        contact_features(points[:, :6], sure)
    with pytest.raises(ValueError, match="camera"):
        contact_features(legs(), SURE, np.eye(3))


def test_the_mirror_image_swaps_the_legs() -> None:
    points, sure = legs(), np.random.default_rng(2).random((20, 7)) + 0.1
    mirrored = torch.from_numpy(contact_features(*mirrored_legs(points, sure)))
    torch.testing.assert_close(mirrored_features(torch.from_numpy(contact_features(points, sure))), mirrored)
    torch.testing.assert_close(mirrored_features(mirrored), torch.from_numpy(contact_features(points, sure)))


def test_it_sees_sixteen_frames_to_either_side() -> None:
    torch.manual_seed(0)
    network, points, sure = ContactNetwork((32,)).eval(), legs(80), np.ones((80, 7))
    told = network.probabilities(points, sure)
    assert told.shape == (80, 2)
    assert ((told > 0) & (told < 1)).all()
    sure[40] = 0.5  # nothing but frame 40's confidences change
    other = np.flatnonzero((network.probabilities(points, sure) != told).any(axis=1))
    assert (other.min(), other.max()) == (24, 56)


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_see_the_body(kind: str) -> None:
    target = np.stack([np.linspace(0, 4, 60), np.zeros(60), np.ones(60)], axis=1)
    camera = draw_camera(kind, target, 30.0, np.random.default_rng(4))
    np.testing.assert_allclose(camera.axes @ camera.axes.transpose(0, 2, 1), np.tile(np.eye(3), (60, 1, 1)), atol=1e-9)
    assert (camera.axes[:, 1, 2] < 0).all()  # the camera's y points down
    head, foot = target + np.array([0, 0, 0.7]), target - np.array([0, 0, 0.9])
    pictures, depth = project(camera, np.stack([target, head, foot], axis=1))
    assert (depth > 2.0).all()
    assert (pictures[:, 1, 1] < pictures[:, 2, 1]).all()
    # The pinhole: 1.6 m at this depth and focal length, foreshortened by the camera's pitch at most.
    high = np.linalg.norm(pictures[:, 2] - pictures[:, 1], axis=-1)
    np.testing.assert_array_less(high, 1.25 * 1.6 * camera.focal / depth[:, 0])
    if kind == "fixed":
        assert np.ptp(camera.positions, axis=0).max() == 0
    elif kind == "track":
        assert np.ptp(camera.positions[:, 0]) > 2
        assert np.abs(pictures[:, 0]).max() < 0.4
    else:
        assert np.ptp(camera.positions, axis=0).max() == 0
        assert np.abs(pictures[:, 0]).max() < 0.4
    assert (np.ptp(camera.focal) > 0) == (kind == "zoom")
    with pytest.raises(ValueError, match="fixed"):
        draw_camera("drone", target, 30.0, np.random.default_rng(0))


def test_the_background_tells_how_a_camera_turned() -> None:
    """A far point that does not move stays where it was once a pan is undone; as seen it leaves its place."""
    target = np.stack([np.linspace(0, 2, 40), np.zeros(40), np.ones(40)], axis=1)
    camera = draw_camera("pan", target, 30.0, np.random.default_rng(5))
    undo = background_motion(camera, target.mean(axis=0), np.random.default_rng(6))
    ahead = camera.positions[0] + 8.0 * camera.axes[10, 2]
    pictures, _ = project(camera, np.tile(ahead, (40, 1, 1)))
    homogeneous = np.concatenate([pictures[:, 0], np.ones((40, 1))], axis=1)
    back = np.einsum("tij,tj->ti", undo, homogeneous)[:, :2]
    assert np.ptp(pictures[:9, 0, 0]) > 5 * np.ptp(back[:9, 0])
