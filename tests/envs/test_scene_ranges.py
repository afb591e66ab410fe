"""Changes of boxes: there and back, within their ranges, and bodies moved with them."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.envs.scene_ranges import SceneRanges, depth_in_scene, moved_with


def ranges() -> SceneRanges:
    """Two boxes: one free along and in height (not evenly), one in yaw alone."""
    tops = torch.tensor([[1.0, 2.0, 0.5], [0.0, 0.0, 0.3]], dtype=torch.float64)
    low = torch.tensor([[-0.3, 0.0, -0.1, 0.0], [0.0, 0.0, 0.0, -0.2]], dtype=torch.float64)
    high = torch.tensor([[0.3, 0.0, 0.5, 0.0], [0.0, 0.0, 0.0, 0.2]], dtype=torch.float64)
    return SceneRanges(tops, torch.tensor([math.pi / 2, 0.1], dtype=torch.float64), low, high, 3.0)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_parameters_are_changes_over_their_range(numbers: list[float]) -> None:
    told = ranges()
    assert told.size == 3
    e = torch.tensor(numbers, dtype=torch.float64)
    change = told.change_of(e)
    torch.testing.assert_close(told.change(*told.changed(change)), change)
    torch.testing.assert_close(told.parameters(change), e)
    assert (change[~told.free] == 0).all()


def test_along_is_the_boxs_own_x_and_the_middle_of_a_range_is_zero() -> None:
    told = ranges()
    change = told.change_of(torch.tensor([1.0, 0.0, -1.0], dtype=torch.float64))
    tops, headings = told.changed(change)
    torch.testing.assert_close(tops[0], torch.tensor([1.0, 2.3, 0.7], dtype=torch.float64))  # turned by 90 degrees
    assert headings.tolist() == pytest.approx([math.pi / 2, -0.1])


def test_draws_fill_their_ranges_and_repeat_with_the_generator() -> None:
    told = ranges()
    drawn = told.drawn(2000, torch.Generator().manual_seed(1))
    assert ((drawn >= told.low) & (drawn <= told.high)).all()
    assert (drawn[:, 0, 2].min(), drawn[:, 0, 2].max()) == pytest.approx((-0.1, 0.5), abs=0.01)
    assert torch.equal(drawn, told.drawn(2000, torch.Generator().manual_seed(1)))


def test_no_face_is_below_the_floor() -> None:
    tops, _ = ranges().changed(torch.tensor([[0.0, 0.0, -0.9, 0.0], [0.0, 0.0, 0.0, 0.0]], dtype=torch.float64))
    assert float(tops[0, 2]) == 0.0


def test_a_body_keeps_its_place_on_the_box() -> None:
    qpos = torch.tensor([[1.2, 2.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.7]], dtype=torch.float64)
    qvel = torch.tensor([[1.0, 0.0, 0.5, 0.1, 0.2, 0.3, 4.0]], dtype=torch.float64)
    start = torch.tensor([[1.0, 2.0, 0.5]], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    to = torch.tensor([[3.0, 2.0, 0.4]], dtype=torch.float64), torch.full((1,), math.pi / 2, dtype=torch.float64)
    places, speeds = moved_with(qpos, qvel, start, to)
    half = math.sqrt(0.5)
    expected = torch.tensor([[3.0, 2.2, 1.4, half, 0.0, 0.0, half, 0.7]], dtype=torch.float64)
    torch.testing.assert_close(places, expected)
    torch.testing.assert_close(speeds, torch.tensor([[0.0, 1.0, 0.5, 0.1, 0.2, 0.3, 4.0]], dtype=torch.float64))


def test_how_far_a_body_must_be_raised() -> None:
    """A box of 0.4 x 1 m, turned by 90 degrees, its face at (1, 2, 0.5)."""
    tops = torch.tensor([[[1.0, 2.0, 0.5]]], dtype=torch.float64).expand(6, 1, 3)
    headings = torch.full((6, 1), math.pi / 2, dtype=torch.float64)
    sizes = torch.tensor([[0.4, 1.0]], dtype=torch.float64)
    points = [
        (1.4, 2.1, 0.3),  # 0.2 under the face: 0.4 across, 0.1 along
        (1.4, 2.3, 0.3),  # 0.3 along: beside it
        (1.0, 2.0, 0.7),  # above
        (3.0, 0.0, -0.1),  # in the floor
        (1.0, 2.0, -0.05),  # nearly too deep to have come from above
        (1.4, 2.1, 0.45),
    ]
    depth = depth_in_scene(torch.tensor(points, dtype=torch.float64)[:, None], tops, headings, sizes)
    assert depth.tolist() == pytest.approx([0.2, 0.0, 0.0, 0.1, 0.55, 0.05])
