"""Evaluation as a live stream: where a motion begins, what a look-ahead shows, and which settings a stream lacks."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from helpers.live_stand_in import untrained
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.evaluation.live_run import begun_at, live_estimates
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.planners import read_planner
from egopose.inference.stream.build import live_body, live_regression
from egopose.pipeline.agent import Agent

NUMBERS = st.floats(-3, 3)


def upright(place: np.ndarray, degrees: float, tilt: float) -> np.ndarray:
    """A root at ``place`` that faces ``degrees`` and leans by ``tilt`` degrees, with one joint."""
    x, y, z, w = Rotation.from_euler("ZY", [degrees, tilt], degrees=True).as_quat()
    return np.array([*place, w, x, y, z, 0.3])


@given(arrays(float, (3, 3), elements=NUMBERS), st.floats(-180, 180), st.floats(-180, 180), st.floats(-30, 30))
def test_a_motion_keeps_its_shape_where_it_is_begun(
    places: np.ndarray, facing: float, wanted: float, tilt: float
) -> None:
    qpos = np.stack([upright(place, facing + 20 * t, tilt) for t, place in enumerate(places)])
    where = upright(np.array([0.5, -0.7, 0.2]), wanted, 0.0)
    moved = begun_at(qpos, where)
    np.testing.assert_allclose(moved[0, :2], where[:2], atol=1e-9)
    np.testing.assert_allclose(moved[:, 2], qpos[:, 2], atol=1e-9)  # heights are the body's own
    np.testing.assert_allclose(moved[:, 7:], qpos[:, 7:])
    expected = Rotation.from_euler("z", wanted - facing, degrees=True)
    steps = expected.apply(np.diff(qpos[:, :3], axis=0))
    np.testing.assert_allclose(np.diff(moved[:, :3], axis=0), steps, atol=1e-6)
    turned = [Rotation.from_quat(row[[4, 5, 6, 3]]) for row in (moved[1], upright(places[1], wanted + 20, tilt))]
    assert (turned[0].inv() * turned[1]).magnitude() < 1e-6


@pytest.mark.parametrize(("task", "told"), [("residual", False), ("tracked_estimation", True)])
def test_a_policy_that_looks_ahead_is_told_of_the_look_ahead_without_a_planner(task: str, told: bool) -> None:
    trained = untrained("tracking" if told else "fast", task)
    regression = live_regression(trained, 4, None)
    body = live_body(trained, FailSafeSettings("off", 0.3, 0.3), None, None)
    features = torch.randn(9, trained.regressor.context.feature_size, generator=torch.Generator().manual_seed(1))
    seen = [row for row in (regression.push(t, row) for t, row in enumerate(features)) if row is not None]
    assert [row.later is not None for row in seen] == [told] * 5
    with torch.no_grad():
        assert [body.advance(row).frame for row in seen] == list(range(5))


@pytest.mark.parametrize(
    ("planner", "restart", "named"),
    [
        ("trajectory", "own", "planner=live"),
        ("gauss_newton", "own", "planner=live"),
        ("none", "path", "failsafe: restart"),
    ],
)
def test_what_a_stream_lacks_is_refused(planner: str, restart: str, named: str) -> None:
    settings = read_planner(compose_config("evaluate", ["checkpoint=none", f"planner={planner}"]).get("planner"))
    agent = cast(Any, Agent)(None, None, {}, None, None, Path("run"))
    failsafe = FailSafeSettings("value", 0.3, 0.3, restart)
    with pytest.raises(InputError, match=named):
        live_estimates(agent, [], failsafe, 10, 1, settings)
