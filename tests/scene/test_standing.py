"""Where a reference stands among boxes, and how it is moved when they are elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.motion.rotations import Array
from egopose.scene.root import Support
from egopose.scene.standing import Standing, standing

FPS = 30.0
SUPPORTS = (Support(0, 0, 20, 0.0), Support(1, 25, 45, 0.4), Support(0, 60, 80, 0.02))
SIZES = np.array([[0.6, 1.0]])


def feet() -> Array:
    """``[80, 2, 2]`` m: the left foot steps on a box at x = 1, the right one walks from 0 to 2."""
    out = np.zeros((80, 2, 2))
    out[:, 1, 0] = 1.0
    out[50:, 0, 0] = 2.0
    return out


def stands() -> Standing:
    return standing(SUPPORTS, [-1, 0, -1], feet(), 80, FPS)


def test_every_frame_stands_on_something() -> None:
    found = stands()
    np.testing.assert_allclose(found.share.sum(axis=1), 1.0)
    assert found.share[10, 0] > 0.99
    assert found.share[35, 1] > 0.99
    assert 0.2 < found.share[52, 1] < 0.8  # in the air between two supports


@settings(max_examples=30, deadline=None)
@given(st.floats(0.0, 0.8), st.floats(-1.0, 1.0))
def test_a_motion_stands_at_the_height_of_its_boxes(height: float, place: float) -> None:
    found = stands()
    tops, headings = np.array([[[1.0 + place, 0.0, height]]]), np.zeros((1, 1))
    moves = found.moves(tops, headings, SIZES)[0]
    assert moves[35, 2] == pytest.approx(height - 0.4, abs=0.02)
    assert moves[5] == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    # Its foot is then on the box, and was moved no further than to the edge's margin.
    foot = 1.0 + moves[35, 0]
    assert abs(foot - (1.0 + place)) <= 0.2 + 0.02
    if abs(place) <= 0.2:
        assert abs(moves[35, 0]) < 1e-9
    assert found.ground(tops)[0, 35] == pytest.approx(height, abs=0.02)


def test_turned_boxes_take_feet_in_their_own_axes() -> None:
    found = stands()
    tops = np.array([[[1.0, 0.7, 0.4]]])
    lengthwise = found.moves(tops, np.array([[0.5 * np.pi]]), SIZES)[0, 35]
    across = found.moves(tops, np.array([[0.0]]), SIZES)[0, 35]
    assert lengthwise[1] == pytest.approx(0.7 - 0.2, abs=0.02)
    assert across[1] == pytest.approx(0.7 - 0.4, abs=0.02)


def test_without_boxes_a_motion_stays_but_for_its_height() -> None:
    found = standing(SUPPORTS[:1], [-1], feet(), 80, FPS)
    none = np.zeros((2, 0, 3)), np.zeros((2, 0)), np.zeros((0, 2))
    np.testing.assert_allclose(found.moves(*none), 0.0)


def test_a_motion_that_stands_on_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="no support"):
        standing((), [], feet(), 80, FPS)
