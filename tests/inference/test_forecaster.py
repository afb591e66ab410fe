"""ReferenceForecasts: deterministic, of any length, from the state given; bands that cover what they say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers.forecasting_run import CONTEXT, configuration, forecasting_dataset

from egopose.data.windows import ForecastWindow
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.foot_geometry import out_of_floor
from egopose.inference.bands import fit_scale, quantile_bands
from egopose.inference.forecaster import Forecasts, forecast
from egopose.models.placed_states import placed_states
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks

MATERIAL = forecasting_dataset()
WINDOWS = [ForecastWindow(0, 3, CONTEXT, 6), ForecastWindow(1, 8, CONTEXT, 6)]
NOW = torch.tensor([7, 52])


@pytest.fixture(scope="module")
def actor() -> Any:
    torch.manual_seed(0)
    env = build_env(configuration(), MATERIAL, num_envs=1)
    actor, _ = build_networks(configuration(), MATERIAL, env)
    for parameter in actor.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    return actor


def futures(actor: Any, samples: int = 1, horizon: int = 6, seed: int = 0, qpos: Any = None) -> Forecasts:
    pieces = [window for window in WINDOWS for _ in range(samples)]
    env = build_env(
        configuration(), MATERIAL, num_envs=len(pieces), fragments=pieces, whole_fragments=True, falls_end=False
    )
    given = MATERIAL.reference["qpos"][NOW] if qpos is None else qpos
    try:
        return forecast(env, actor, given, MATERIAL.reference["qvel"][NOW], samples, horizon, seed)
    finally:
        env.close()


def test_the_mean_future_repeats_to_the_bit_and_goes_on_beyond_the_window(actor: Any) -> None:
    first, second = futures(actor), futures(actor, seed=7)
    assert first.qpos.shape == (2, 1, 6, MATERIAL.humanoid.mj_model.nq)
    np.testing.assert_array_equal(first.qpos, second.qpos)
    longer = futures(actor, horizon=30)  # past the window's end, and the second one's take's
    np.testing.assert_array_equal(longer.qpos[:, :, :6], first.qpos)
    assert np.isfinite(longer.qpos).all()
    assert (np.abs(np.diff(longer.qpos, axis=2)).max(axis=(1, 3)) > 0).all()
    # It begins one step away from the state given.
    assert np.abs(first.qpos[:, 0, 0, :3] - MATERIAL.reference["qpos"][NOW, :3].numpy()).max() < 0.05


def test_futures_are_drawn_by_their_seed_alone(actor: Any) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first, again, other = futures(actor, 3), futures(actor, 3), futures(actor, 3, seed=1)
    assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(first.qpos, again.qpos)
    assert not np.array_equal(first.qpos, other.qpos)
    spread = first.qpos.std(axis=1)[..., 7:]
    assert (spread.max(axis=-1) > 1e-3).all()


def test_each_window_goes_on_from_its_own_state_and_video(actor: Any) -> None:
    both = futures(actor).qpos
    moved = MATERIAL.reference["qpos"][NOW].clone()
    moved[1, 7] += 0.2
    changed = futures(actor, qpos=moved).qpos
    np.testing.assert_array_equal(changed[0], both[0])
    assert not np.array_equal(changed[1], both[1])


def test_physics_that_breaks_stands_still(actor: Any) -> None:
    def broken(observation: Any) -> Any:
        observation = actor(observation)
        if int(observation["episode_step"][0]) == 2:
            observation["action"][0] = float("nan")
        return observation

    result = futures(broken)
    assert result.diverged.tolist() == [[True], [False]]
    np.testing.assert_array_equal(result.qpos[0, 0, 2:], result.qpos[0, 0, [1] * 4])


def test_worlds_must_fit(actor: Any) -> None:
    env = build_env(configuration(), MATERIAL, num_envs=3)
    with pytest.raises(ValueError, match="need as many worlds"):
        forecast(env, actor, MATERIAL.reference["qpos"][NOW], MATERIAL.reference["qvel"][NOW])


def test_an_estimated_state_is_put_where_the_person_stands() -> None:
    reference = MATERIAL.reference["qpos"][NOW].numpy()
    states = humanoid_state(MATERIAL.reference[NOW]).numpy()
    qpos, qvel = placed_states(states, reference, MATERIAL.humanoid)
    np.testing.assert_allclose(qpos.numpy(), out_of_floor(MATERIAL.humanoid, reference), atol=1e-9)
    np.testing.assert_allclose(qvel.numpy(), MATERIAL.reference["qvel"][NOW].numpy(), atol=1e-9)


def test_calibrated_bands_cover_held_out_truth() -> None:
    """ReferenceForecasts drawn far too alike, and more so later: calibrated, 80 % means 80 %."""
    generator = np.random.default_rng(0)
    windows, drawn, frames, joints = 400, 30, 5, 8
    centre = generator.normal(size=(windows, 1, frames, joints))
    sigma = np.linspace(0.1, 1.0, frames)[:, None]
    samples = centre + 0.05 * generator.normal(size=(windows, drawn, frames, joints))
    truth = centre[:, 0] + sigma * generator.normal(size=(windows, frames, joints))
    bands = quantile_bands(samples, 0.8)
    half = windows // 2
    known, held_out = quantile_bands(samples[:half], 0.8), quantile_bands(samples[half:], 0.8)
    assert bands.covers(truth).mean() < 0.3
    scale = fit_scale(known, truth[:half], 0.8)
    assert (np.diff(scale) > 0).all()
    assert known.scaled(scale).covers(truth[:half]).mean(axis=(0, 2)) == pytest.approx(0.8, abs=2e-3)
    assert held_out.scaled(scale).covers(truth[half:]).mean() == pytest.approx(0.8, abs=0.02)
    with pytest.raises(ValueError, match="two futures"):
        quantile_bands(samples[:, :1])


def test_bands_are_the_quantiles_and_never_without_width() -> None:
    samples = np.arange(11.0)[None, :, None, None] * np.array([1.0, 0.0])
    bands = quantile_bands(samples, 0.8)
    assert (bands.low[0, 0, 0], bands.median[0, 0, 0], bands.high[0, 0, 0]) == pytest.approx((1, 5, 9))
    assert bands.low[0, 0, 1] < 0 < bands.high[0, 0, 1]
    wide = bands.scaled(np.array([2.0]))
    assert (wide.low[0, 0, 0], wide.high[0, 0, 0]) == pytest.approx((-3, 13))
