"""The contact network's windows and vote, and cameras against the pinhole's formula."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from egopose.scene.contacts import (
    INPUTS,
    LABELS,
    LOWER_BODY,
    WINDOW,
    ContactNetwork,
    contact_windows,
    estimate_contacts,
    labels_of_windows,
    mirrored_windows,
    vote,
)
from egopose.scene.virtual_camera import KINDS, background_motion, draw_camera, project


def keypoints(frames: int = 20, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.normal(size=(1, 7, 2)) + 0.05 * random.normal(size=(frames, 7, 2)).cumsum(axis=0)


def test_windows_are_centred_and_scaled() -> None:
    points = keypoints()
    windows = contact_windows(points, np.ones((20, 7))).reshape(20, WINDOW, 7, 3)
    np.testing.assert_allclose(windows[:, WINDOW // 2, 0, :2], 0.0, atol=1e-7)
    np.testing.assert_allclose(np.abs(windows[..., :2]).max(axis=(1, 2, 3)), 0.8, rtol=1e-6)
    # Frame 10's window, by hand.
    by_hand = points[6:15] - points[10, 0]
    np.testing.assert_allclose(windows[10, ..., :2], 0.8 * by_hand / np.abs(by_hand).max(), rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(windows[0, 0], windows[0, 4])


@given(shift=st.tuples(*[st.floats(-1e3, 1e3)] * 2), scale=st.floats(0.01, 1e3))
def test_place_and_unit_do_not_matter(shift: tuple[float, float], scale: float) -> None:
    points, sure = keypoints(12), np.full((12, 7), 0.5)
    np.testing.assert_allclose(
        contact_windows(points * scale + shift, sure), contact_windows(points, sure), atol=2e-4 / min(scale, 1.0)
    )


def test_a_camera_that_is_known_is_undone() -> None:
    """Pictures moved by similarities give the windows of the still camera, up to the middle frame's own roll."""
    points, frames = keypoints(30, 3), 30
    random = np.random.default_rng(1)
    angle, zoom = 0.02 * random.normal(size=frames).cumsum(), np.exp(0.1 * random.normal(size=frames))
    move = random.normal(size=(frames, 2)).cumsum(axis=0)
    camera = np.tile(np.eye(3), (frames, 1, 1))
    camera[:, 0, 0] = camera[:, 1, 1] = zoom * np.cos(angle)
    camera[:, 1, 0], camera[:, 0, 1] = zoom * np.sin(angle), -zoom * np.sin(angle)
    camera[:, :2, 2] = move
    homogeneous = np.concatenate([points, np.ones((frames, 7, 1))], axis=-1)
    seen = np.einsum("tij,tkj->tki", np.linalg.inv(camera), homogeneous)[..., :2]
    sure = np.ones((frames, 7))
    undone = contact_windows(seen, sure, camera).reshape(frames, WINDOW, 7, 3)[..., :2]
    still = contact_windows(points, sure).reshape(frames, WINDOW, 7, 3)[..., :2]
    # A common roll and the scale to 0.8 are what may differ.
    one, other = (np.linalg.norm(w, axis=-1) for w in (undone, still))
    knee = (slice(None), slice(WINDOW // 2, WINDOW // 2 + 1), slice(3, 4))
    np.testing.assert_allclose(one / one[knee], other / other[knee], rtol=1e-4, atol=1e-6)
    as_seen = contact_windows(seen, sure).reshape(frames, WINDOW, 7, 3)[..., :2]
    assert np.abs(as_seen - still).max() > 0.1


def test_unseen_joints_stand_at_the_centre() -> None:
    points, sure = keypoints(), np.ones((20, 7))
    points[8, 3], sure[8, 3] = np.nan, 0.0
    window = contact_windows(points, sure).reshape(20, WINDOW, 7, 3)
    np.testing.assert_array_equal(window[8, WINDOW // 2, 3], 0.0)
    assert np.isfinite(window).all()
    sure[8, 3] = 0.1
    with pytest.raises(ValueError, match="finite"):
        contact_windows(points, sure)
    with pytest.raises(ValueError, match=r"T, 7, 2"):
        contact_windows(points[:, :6], sure)
    with pytest.raises(ValueError, match="camera"):
        contact_windows(keypoints(), np.ones((20, 7)), np.eye(3))


def test_the_vote_gives_back_what_all_windows_agree_on() -> None:
    contacts = np.random.default_rng(0).random((15, 2)) < 0.5
    labels = labels_of_windows(contacts)
    assert labels.shape == (15, LABELS, 2)
    np.testing.assert_array_equal(vote(labels.astype(float)), contacts)
    # One window of five that is wrong about a frame does not turn it.
    wrong = labels.astype(float)
    wrong[6, 2] = 1 - wrong[6, 2]
    np.testing.assert_array_equal(vote(wrong) > 0.5, contacts)
    np.testing.assert_allclose(np.abs(vote(wrong)[6] - contacts[6]), 0.2)


def test_the_mirror_image_swaps_the_legs() -> None:
    points, sure = keypoints(), np.random.default_rng(2).random((20, 7)) + 0.1
    other = [LOWER_BODY.index(swapped(n)) for n in LOWER_BODY]
    mirrored = contact_windows((points * [-1, 1])[:, other], sure[:, other])
    torch.testing.assert_close(
        mirrored_windows(torch.from_numpy(contact_windows(points, sure))), torch.from_numpy(mirrored)
    )


def swapped(name: str) -> str:
    return name.replace("right", "x").replace("left", "right").replace("x", "left")


def test_the_network_is_the_papers() -> None:
    network = ContactNetwork().eval()
    sizes = [layer.out_features for layer in network.layers if isinstance(layer, torch.nn.Linear)]
    assert (INPUTS, sizes) == (189, [1024, 512, 128, 32, 10])
    told = estimate_contacts(network, keypoints(), np.ones((20, 7)))
    assert told.shape == (20, 2)
    assert ((told > 0) & (told < 1)).all()


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
