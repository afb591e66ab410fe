"""A path is laid where a body stands: exactly, and alike wherever in the world that is."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from egopose.envs.mdp import rotations as rot
from egopose.envs.mdp.path import lay, on_path, root_on_floor, turned
from egopose.inference.followed_path import FollowedPath

places = st.floats(-50.0, 50.0)
angles = st.floats(-9.0, 9.0)
rows = st.tuples(places, places, angles)


def of(*values: tuple[float, float, float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def assert_same_place(first: Tensor, second: Tensor) -> None:
    torch.testing.assert_close(first[:, :2], second[:, :2], atol=1e-9, rtol=0)
    assert rot.wrapped(first[:, 2] - second[:, 2]).abs().max() < 1e-9


def standing(rows: Tensor, height: float = 0.9) -> Tensor:
    """``qpos [N, 8]`` of upright bodies that stand and face so."""
    out = torch.zeros(len(rows), 8, dtype=torch.float64)
    out[:, :2], out[:, 2] = rows[:, :2], height
    out[:, 3], out[:, 6] = torch.cos(rows[:, 2] / 2), torch.sin(rows[:, 2] / 2)
    return out


@given(rows, rows)
def test_a_laid_row_is_where_the_body_is(row: tuple[float, ...], body: tuple[float, ...]) -> None:
    path, root = of(row), of(body)
    assert_same_place(on_path(lay(path, root), root), path)


@given(rows, rows, rows, rows)
def test_a_body_moved_with_its_world_sees_the_same(
    row: tuple[float, ...], start: tuple[float, ...], later: tuple[float, ...], move: tuple[float, ...]
) -> None:
    path, there = of(row), of(start, later)

    def carried(root: Tensor) -> Tensor:
        angle = torch.full((len(root),), move[2], dtype=torch.float64)
        return torch.cat([turned(root[:, :2], angle) + of(move)[:, :2], root[:, 2:] + move[2]], dim=-1)

    seen = [on_path(lay(path, roots[:1]), roots[1:]) for roots in (there, carried(there))]
    assert_same_place(*seen)


@given(rows, rows, rows, rows)
def test_a_path_that_stays_where_it_was_laid_is_the_planners(
    first: tuple[float, ...], second: tuple[float, ...], start: tuple[float, ...], later: tuple[float, ...]
) -> None:
    """The place that a planner follows, brought back to the path's axes, is the path's row."""
    path = of(first, second)
    followed = FollowedPath(path, 1.0 / 30.0, math.inf, math.inf)
    followed.advance(torch.tensor([0]), standing(of(start)))
    followed.advance(torch.tensor([1]), standing(of(later)))
    place, heading = followed.at(torch.tensor([1]))
    placement = lay(path[:1], of(start))
    assert_same_place(on_path(placement, torch.cat([place, heading[:, None]], dim=-1)), path[1:])


def test_a_quarter_turn_by_hand() -> None:
    """A path along x, laid for a body that faces along y: a step ahead of the body is a step along the path."""
    placement = lay(of((1.0, 0.0, 0.0)), of((5.0, 5.0, math.pi / 2)))
    seen = on_path(placement, of((5.0, 7.0, math.pi / 2), (4.0, 5.0, math.pi)).clone())
    expected = of((3.0, 0.0, 0.0), (1.0, 1.0, math.pi / 2))
    torch.testing.assert_close(seen, expected, atol=1e-12, rtol=0)


def test_the_root_on_the_floor_has_no_tilt() -> None:
    """A body that leans and sinks stands and faces where it did."""
    upright = standing(of((1.0, -2.0, 0.7), (0.0, 3.0, -2.5)))
    lean = torch.tensor([[math.cos(0.2), 0.0, math.sin(0.2), 0.0]], dtype=torch.float64).expand(2, 4)
    leaning = upright.clone()
    leaning[:, 2], leaning[:, 3:7] = 0.5, rot.multiply(upright[:, 3:7], lean)
    torch.testing.assert_close(root_on_floor(leaning), of((1.0, -2.0, 0.7), (0.0, 3.0, -2.5)), atol=1e-12, rtol=0)
    torch.testing.assert_close(root_on_floor(leaning), root_on_floor(upright), atol=1e-12, rtol=0)


def test_headings_count_beyond_a_turn() -> None:
    """A path's headings run on behind a full turn; the body's own do not, and see no difference of a turn."""
    path, root = of((0.0, 0.0, 7.0)), of((0.0, 0.0, 7.0 - 2 * math.pi))
    assert float(lay(path, root)[0, 0]) == pytest.approx(0.0, abs=1e-12)
