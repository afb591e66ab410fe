"""Recurrent forecasters: what they are fed while training, and that they learn what can be learned."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from egopose.core.errors import InputError
from egopose.data.spans import Span
from egopose.humanoid.state_layout import StateLayout
from egopose.models.baselines.recurrent import RecurrentForecaster, ground_truth_mask
from egopose.models.mirror import StateMirror
from egopose.training.fitting import Fit, FitSettings, fit
from egopose.training.recurrent_baselines import RecurrentLearner, RecurrentSettings

FIT = FitSettings(5e-3, 0.0, 1.0, batch=8, validation_share=0.2, check_every=20, patience=100, threads=1)
ERD = RecurrentSettings((16,), 24, 1, (16,), False, "noise", 0.05, 0.5, 0, 0, context=10, horizon=20, std_floor=0.05)
ACLSTM = replace(ERD, encoder=(), decoder=(), scheme="alternate", input_noise=0.0, truth=5, own=5)


def waves(frames: int = 400) -> torch.Tensor:
    """``[F, 3]`` sines of one period of 12 frames."""
    t = torch.arange(frames)[:, None] * 2 * math.pi / 12
    return torch.sin(t + torch.tensor([0.0, 1.0, 2.0])) + torch.tensor([1.0, 0.0, -3.0])


def learner(settings: RecurrentSettings = ERD) -> RecurrentLearner:
    return RecurrentLearner(waves(), [Span(0, 200), Span(200, 400)], settings, 8, 0.2, seed=1)


def test_truth_and_own_output_alternate_at_fixed_lengths() -> None:
    assert ground_truth_mask(12, 3, 2).tolist() == [True, True, True, False, False] * 2 + [True, True]
    assert ground_truth_mask(7, 1, 2, offset=2).tolist() == [True, True, True, False, False, True, False]


def test_own_output_is_fed_exactly_where_the_mask_is_false() -> None:
    network = RecurrentForecaster(torch.zeros(2), torch.ones(2), (4,), 5, 2, (), residual=True).eval()
    poses, truth = torch.randn(3, 9, 2), ground_truth_mask(9, 2, 3)
    got = network.conditioned(poses, truth)
    memory, last, expected = None, poses[:, :1], []
    for t in range(9):
        out, memory = network(poses[:, t : t + 1] if truth[t] else last, memory)
        expected.append(out)
        last = out
    assert torch.allclose(got, torch.cat(expected, dim=1), atol=1e-6)
    # What stands where the own output is fed is never read.
    changed = poses.clone()
    changed[:, ~truth] = 1e3
    assert torch.equal(network.conditioned(changed, truth), got)


@pytest.mark.parametrize("settings", [ERD, ACLSTM], ids=["erd", "aclstm"])
def test_both_schemes_learn_to_go_on_with_a_sine(settings: RecurrentSettings) -> None:
    work = learner(settings)
    before = work.held_out()
    result = fit(work, FIT, seed=0, total_frames=50_000)
    # Errors are in deviations: going nowhere costs about one or two.
    assert before > 0.7
    assert result.held_out < 0.1
    assert result.held_out == pytest.approx(work.held_out())
    forecast = work.model.forecast(waves()[None, 100:110], 12)
    assert (forecast[0] - waves()[110:122]).abs().mean() < 0.25


@pytest.mark.parametrize("settings", [ERD, ACLSTM])
def test_half_of_the_windows_are_mirror_images_where_there_is_a_mirror(settings: RecurrentSettings) -> None:
    """Of truths and inputs alike, those held out never: one that negates all shows which windows it was."""
    mirror = StateMirror(torch.arange(3), -torch.ones(3))
    poses, spans = waves() + 5.0, [Span(0, 200), Span(200, 400)]
    work = RecurrentLearner(poses, spans, settings, 256, 0.2, 1, mirror)
    given: list[torch.Tensor] = []
    for name in ("forward", "conditioned"):
        whole = getattr(work.model, name)

        def spy(rows: torch.Tensor, *rest: Any, whole: Any = whole) -> Any:
            given.append(work.model.denormalise(rows))
            return whole(rows, *rest)

        setattr(work.model, name, spy)
    work.loss(torch.Generator().manual_seed(0), 0.0)
    shown = given[0][:, :, 0].sign()
    assert (shown == shown[:, :1]).all(), "a window is mirrored whole"
    assert 0.35 < float((shown[:, 0] < 0).float().mean()) < 0.65
    given.clear()
    work.held_out()
    assert (given[0][:, :, 0] > 0).all()


def test_a_training_that_was_cut_off_ends_as_one_left_alone() -> None:
    whole, parted, saved = learner(), learner(), []
    first = fit(whole, FIT, seed=0, total_frames=20_000)
    fit(parted, FIT, seed=0, total_frames=20_000, max_seconds=0.0, save=lambda work: saved.append(work.state()))
    assert not saved[-1]["counters"].any()

    def interrupt(work: Fit) -> None:
        saved.append(work.state())
        if work.result.steps >= 60:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(parted, FIT, seed=0, total_frames=20_000, save=interrupt)
    again = learner()
    second = fit(again, FIT, seed=0, total_frames=20_000, resume=saved[-1])
    assert second == first
    for a, b in zip(whole.model.parameters(), again.model.parameters(), strict=True):
        assert torch.equal(a, b)


def test_short_fragments_are_trained_on_up_to_their_ends_only() -> None:
    poses = torch.zeros(40, 3)
    poses[20:] = 1e6  # another take's
    poses[:20] = waves(20)
    work = RecurrentLearner(poses, [Span(0, 20)], ERD, 4, 0.0, seed=0)
    loss, frames = work.loss(torch.Generator().manual_seed(0), 0.0)
    assert frames == 4 * 20
    assert float(loss.detach()) < 10
    assert math.isnan(work.held_out())


def test_settings_out_of_range_and_other_models_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="scheme"):
        RecurrentSettings.from_config({**vars(ERD), "scheme": "hope"})
    with pytest.raises(InputError, match="truth"):
        RecurrentSettings.from_config({**vars(ACLSTM), "truth": 0})
    with pytest.raises(InputError, match="batch"):
        FitSettings.from_config({**vars(FIT), "batch": 0})
    with pytest.raises(InputError, match="model/"):
        Fit(learner(), FIT).load(Fit(learner(replace(ERD, recurrent=8)), FIT).state())
    assert StateLayout.of_size(115).pose_size == 63
