"""The windows and the vote of the paper's contact network."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.seen_legs import legs, mirrored_legs
from hypothesis import given
from hypothesis import strategies as st

from egopose.scene.window_contacts import (
    INPUTS,
    LABELS,
    WINDOW,
    WindowNetwork,
    contact_windows,
    labels_of_windows,
    mirrored_windows,
    vote,
)


def test_windows_are_centred_and_scaled() -> None:
    points = legs()
    windows = contact_windows(points, np.ones((20, 7))).reshape(20, WINDOW, 7, 3)
    np.testing.assert_allclose(windows[:, WINDOW // 2, 0, :2], 0.0, atol=1e-7)
    np.testing.assert_allclose(np.abs(windows[..., :2]).max(axis=(1, 2, 3)), 0.8, rtol=1e-6)
    # Frame 10's window, by hand.
    by_hand = points[6:15] - points[10, 0]
    np.testing.assert_allclose(windows[10, ..., :2], 0.8 * by_hand / np.abs(by_hand).max(), rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(windows[0, 0], windows[0, 4])


@given(shift=st.tuples(*[st.floats(-1e3, 1e3)] * 2), scale=st.floats(0.01, 1e3))
def test_place_and_unit_do_not_matter(shift: tuple[float, float], scale: float) -> None:
    points, sure = legs(12), np.full((12, 7), 0.5)
    np.testing.assert_allclose(
        contact_windows(points * scale + shift, sure), contact_windows(points, sure), atol=2e-4 / min(scale, 1.0)
    )


def test_a_camera_that_is_known_is_undone() -> None:
    """Pictures that a camera moved give the windows of the still camera."""
    points, frames = legs(30, 3), 30
    move = np.random.default_rng(1).normal(size=(frames, 2)).cumsum(axis=0)
    camera = np.tile(np.eye(3), (frames, 1, 1))
    camera[:, :2, 2] = move
    sure = np.ones((frames, 7))
    undone = contact_windows(points - move[:, None], sure, camera)
    np.testing.assert_allclose(undone, contact_windows(points, sure), atol=1e-6)
    assert np.abs(contact_windows(points - move[:, None], sure) - undone).max() > 0.1


def test_unseen_joints_stand_at_the_centre() -> None:
    points, sure = legs(), np.ones((20, 7))
    points[8, 3], sure[8, 3] = np.nan, 0.0
    window = contact_windows(points, sure).reshape(20, WINDOW, 7, 3)
    np.testing.assert_array_equal(window[8, WINDOW // 2, 3], 0.0)
    assert np.isfinite(window).all()


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
    points, sure = legs(), np.random.default_rng(2).random((20, 7)) + 0.1
    mirrored = contact_windows(*mirrored_legs(points, sure))
    torch.testing.assert_close(
        mirrored_windows(torch.from_numpy(contact_windows(points, sure))), torch.from_numpy(mirrored)
    )


def test_the_network_is_the_papers() -> None:
    network = WindowNetwork().eval()
    sizes = [layer.out_features for layer in network.layers if isinstance(layer, torch.nn.Linear)]
    assert (INPUTS, sizes) == (189, [1024, 512, 128, 32, 10])
    told = network.probabilities(legs(), np.ones((20, 7)))
    assert told.shape == (20, 2)
    assert ((told > 0) & (told < 1)).all()
    with pytest.raises(ValueError, match=r"T, 7, 2"):
        network.probabilities(legs()[:, :6], np.ones((20, 7)))
