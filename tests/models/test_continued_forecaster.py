"""The forecaster that goes on frame by frame: its curve, its share, what it learns from, its settings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from helpers.continued_forecaster import continued, fast
from helpers.env_stand_in import group
from helpers.forecast_curves import FPS, settings, unmirrored, wave
from torch import Tensor

from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.data.spans import Span
from egopose.models.mirror import StateMirror
from egopose.models.motion_forecast import ContinuedForecaster, spline_basis, spline_times
from egopose.training import continued_forecast
from egopose.training.continued_forecast import (
    blank_continued_forecaster,
    continued_share,
    fit_continued_forecaster,
)
from egopose.training.recurrent_baselines import RecurrentLearner

HORIZON = 12


@pytest.fixture(autouse=True)
def _one_thread_and_seed() -> Iterator[None]:
    torch.manual_seed(0)
    with torch_threads(1):
        yield


def with_continued(network: dict[str, Any] | None = None, **changes: Any) -> Any:
    return settings(continued=continued(network, **changes))


# --- the curve -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frames", "spacing"), [(91, 8), (13, 3), (7, 20), (2, 1), (30, 4)])
def test_a_straight_line_has_its_own_values_at_the_splines_times_as_coefficients(frames: int, spacing: int) -> None:
    times, basis = spline_times(frames, spacing), spline_basis(frames, spacing, FPS)[0]
    assert times.shape == basis.shape[1:]
    assert (times[0], times[-1]) == (0, frames - 1)
    assert (times.diff() > 0).all()
    step = torch.arange(float(frames))
    torch.testing.assert_close(basis @ (0.7 - 0.3 * times), 0.7 - 0.3 * step, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("frames", "spacing"), [(1, 8), (13, 0)])
def test_no_spline_has_no_times(frames: int, spacing: int) -> None:
    with pytest.raises(ValueError, match="spline"):
        spline_times(frames, spacing)


@torch.no_grad()
def test_its_curve_is_the_nearest_to_the_last_pose_and_what_its_network_goes_on_with() -> None:
    size, made = 15, with_continued()
    model = blank_continued_forecaster(made, torch.randn(size), 0.5 + torch.rand(size), FPS)
    for weight in model.network.parameters():
        weight.normal_(std=0.4)
    contexts = model.mean + model.std * torch.randn(3, 5, size)
    given = (contexts - model.mean) / model.std
    told = (model(given) * model.std + model.mean).double().numpy()
    after = model.network.forecast(contexts, HORIZON)
    assert after.shape == (3, HORIZON, size)
    poses = torch.cat([contexts[:, -1:], after], dim=1).double().numpy()
    basis = spline_basis(HORIZON + 1, 3, FPS)[0].double().numpy()
    wanted = np.stack([np.linalg.lstsq(basis, one, rcond=None)[0] for one in poses])
    np.testing.assert_allclose(told, wanted, atol=1e-4)
    # What comes after is no straight line from what was seen, or any curve would do.
    assert np.abs(np.diff(poses, 2, axis=1)).max() > 0.1


def test_no_copy_of_what_its_settings_say_is_kept_with_its_weights() -> None:
    model = blank_continued_forecaster(with_continued(), torch.zeros(15), torch.ones(15), FPS)
    assert all(key.startswith("network.") for key in model.state_dict())


# --- its share -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("until", [1, 5, 12, 40])
def test_its_share_falls_in_a_straight_line_to_nothing(until: int) -> None:
    share = continued_share(with_continued(share=0.6, until=until))
    times = spline_times(HORIZON + 1, 3)
    assert share.shape == (len(times), 1)
    assert float(share[0]) == pytest.approx(0.6)
    for found, time in zip(share[:, 0].tolist(), times.tolist(), strict=True):
        assert found == pytest.approx(max(0.0, 0.6 - 0.6 * time / until), abs=1e-6)
    assert not share[times >= until].any()
    if until >= HORIZON:  # and then it is a straight line at every frame, not at the coefficients' times alone
        frames = spline_basis(HORIZON + 1, 3, FPS)[0] @ share
        line = 0.6 * (1 - torch.arange(HORIZON + 1.0) / until)
        torch.testing.assert_close(frames[:, 0], line, atol=1e-5, rtol=0)


# --- the fit ---------------------------------------------------------------------------------------------------------


def test_it_goes_on_with_a_swing_it_has_learned_better_than_untrained() -> None:
    poses = wave(200)
    optimiser = {**fast()["network"]["optimiser"], "batch": 16}
    network = {"recurrent": 16, "mirror": False, "optimiser": optimiser}
    made, errors = with_continued(network=network, total_frames=10_000), []
    now = torch.arange(120, 180)
    contexts, truth = poses[now[:, None] + torch.arange(-11, 1)], poses[now[:, None] + torch.arange(HORIZON + 1)]
    basis = spline_basis(HORIZON + 1, 3, FPS)[0]
    model, result = fit_continued_forecaster(poses, [Span(0, 100)], unmirrored(poses), made, FPS, 0)
    assert not model.training
    assert result.frames < 10_000 + 16 * 11
    for one in (blank_continued_forecaster(made, model.mean, model.std, FPS), model):
        with torch.no_grad():
            curve = basis @ one((contexts - one.mean) / one.std) * one.std + one.mean
        errors.append(float((curve - truth)[..., 5:9].norm(dim=-1).mean()))
    assert errors[1] < 0.9 * errors[0]


def test_it_learns_from_the_fragments_alone_and_the_same_from_the_same_seed() -> None:
    poses, made = wave(120) + 0.1 * torch.randn(120, 15), with_continued()
    spans, mirror = [Span(0, 40), Span(60, 90)], StateMirror(torch.arange(15), -torch.ones(15))
    changed = poses.clone()
    changed[40:60] += 1.0
    changed[90:] += 1.0

    def weights(given: Tensor, seed: int) -> dict[str, Tensor]:
        return fit_continued_forecaster(given, spans, mirror, made, FPS, seed)[0].state_dict()

    first, again, other = weights(poses, 0), weights(changed, 0), weights(poses, 1)
    assert all(torch.equal(value, again[key]) for key, value in first.items())
    assert not torch.equal(first["network.lstm.weight_hh_l0"], other["network.lstm.weight_hh_l0"])


@pytest.mark.parametrize("mirrored", [True, False])
def test_it_learns_from_mirror_images_where_its_network_is_to(mirrored: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    poses, made = wave(60), with_continued(network={"mirror": mirrored})
    mirror, asked = unmirrored(poses), list[tuple[Any, ...]]()

    def learner(*given: Any) -> RecurrentLearner:
        asked.append(given)
        return RecurrentLearner(*given)

    monkeypatch.setattr(continued_forecast, "RecurrentLearner", learner)
    fit_continued_forecaster(poses, [Span(0, 60)], mirror, made, FPS, 7)
    ((_, fragments, network, batch, held_out, seed, images),) = asked
    assert (fragments, network, seed) == ([Span(0, 60)], made.continued.network, 7)
    assert (batch, held_out) == (4, 0.2)
    assert images is (mirror if mirrored else None)


# --- settings --------------------------------------------------------------------------------------------------------


def test_its_network_is_the_baselines() -> None:
    assert fast()["network"] == group("baseline", "aclstm_fast")


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"share": 0.0}, "share"),
        ({"share": 1.1}, "share"),
        ({"until": 0}, "until"),
        ({"total_frames": 0}, "total_frames"),
        ({"speed": 3}, "speed"),
        ({"share": ...}, "share"),
        ({"network": None}, "network"),
        ({"network": group("baseline", "path_pose")}, "network"),
        ({"network": {**group("baseline", "aclstm_fast"), "optimiser": None}}, "network"),
        ({"network": {**group("baseline", "aclstm_fast"), "layers": 0}}, "layers"),
        ({"network": {**group("baseline", "aclstm_fast"), "scheme": "guess"}}, "scheme"),
    ],
)
def test_settings_that_make_none_are_named(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as refused:
        settings(continued={**continued(), **changes})
    assert refused.value.field == field
    assert "continued" in str(refused.value)


def test_without_settings_there_is_none() -> None:
    values = {key: value for key, value in group("forecaster", "fast").items() if key != "optimiser"}
    assert settings(continued=None).continued is None
    made = type(settings()).from_config({key: value for key, value in values.items() if key != "continued"})
    assert made.continued is None
    assert type(settings()).from_config(values).continued is not None


def test_it_is_a_forecaster_as_the_others_are() -> None:
    """Its statistics are its network's, and its curve has as many coefficients."""
    mean, std = torch.randn(15), 0.5 + torch.rand(15)
    model = blank_continued_forecaster(with_continued(), mean, std, FPS)
    assert isinstance(model, ContinuedForecaster)
    assert torch.equal(model.mean, mean)
    assert torch.equal(model.std, std)
    assert model(torch.randn(2, 5, 15)).shape == (2, spline_basis(HORIZON + 1, 3, FPS)[0].shape[1], 15)
