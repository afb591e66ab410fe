"""Training the state regressor: windows, learning, determinism, resume, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from torch import Tensor, nn

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.spans import Span, cross_fit_blocks, split_validation, training_windows, without_block
from egopose.models.mirror import StateMirror
from egopose.models.predictions import predict_span, predict_takes
from egopose.models.regressor import StateRegressor
from egopose.models.regressor_settings import RegressorSettings, learning_rate_at
from egopose.training.regressor import Progress, State, build_regressor, train_regressor

CONF = Path(__file__).resolve().parents[2] / "conf" / "regressor"
FRAGMENTS = [Span(0, 700), Span(700, 1500)]


def load(name: str) -> RegressorSettings:
    return from_mapping(RegressorSettings, yaml.safe_load((CONF / f"{name}.yaml").read_text()), f"regressor/{name}")


QUICK = replace(
    load("fast"),
    hidden=(64,),
    context_size=32,
    dropout=0.0,
    feature_dropout=0.0,
    epochs=60,
    batch_fragments=2,
    mirror=False,
    threads=1,
    validation_share=0.15,
)


class TinyEncoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(2 * 8 * 8, 32), nn.BatchNorm1d(32), nn.ReLU())

    def forward(self, flow: Tensor) -> Tensor:
        return self.layers(flow)


def video_and_states(frames: int = 1500, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two phases of wandering rate, seen in noise: flow ``[F, 2, 8, 8]`` and states ``[F, 21]`` of their harmonics."""
    g = torch.Generator().manual_seed(seed)
    rate = 0.25 + 0.02 * torch.randn(frames, 2, generator=g).cumsum(0).sin()
    phase = rate.cumsum(0)
    seen = torch.cat([phase.cos() * rate, phase.sin() * rate], 1)
    flow = seen @ torch.randn(4, 128, generator=g) + 0.3 * torch.randn(frames, 128, generator=g)
    states = torch.cat([phase.sin(), phase.cos(), (2 * phase).sin(), rate], 1) @ torch.randn(8, 21, generator=g)
    return (0.05 * flow).reshape(frames, 2, 8, 8).half(), states + 0.5


def build(settings: RegressorSettings, states: Tensor) -> StateRegressor:
    torch.manual_seed(1)
    return build_regressor(TinyEncoder(), states, FRAGMENTS, settings, feature_size=32)


def train(
    settings: RegressorSettings,
    save: Callable[[State], None] | None = None,
    resume: State | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> tuple[StateRegressor, list[float], float, float]:
    flow, states = video_and_states()
    model = build(settings, states)
    result = train_regressor(model, flow, states, FRAGMENTS, settings, save=save, resume=resume, progress=progress)
    return model, [p.train_mse for p in result.history], result.validation_mse, result.mean_mse


@pytest.mark.parametrize("name", ["paper", "fast"])
def test_configs_fill_the_settings(name: str) -> None:
    assert load(name).fragment_length == 120


@hypothesis_settings(max_examples=50)
@given(
    spans=st.lists(st.integers(1, 400), min_size=1, max_size=4),
    margin=st.integers(0, 20),
    inner=st.integers(1, 100),
    seed=st.integers(0, 100),
)
def test_windows_cover_each_frame_once_and_stay_in_their_fragment(
    spans: list[int], margin: int, inner: int, seed: int
) -> None:
    at, fragments = 5, []
    for length in spans:
        fragments.append(Span(at, at + length))
        at += length + 3
    windows = training_windows(fragments, inner + 2 * margin, margin, torch.Generator().manual_seed(seed))
    loss = sorted(f for w in windows for f in range(w.loss_start, w.loss_stop))
    assert loss == [f for s in fragments for f in range(s.start, s.stop)]
    for w in windows:
        home = next(s for s in fragments if s.start <= w.loss_start < s.stop)
        assert home.start <= w.start <= w.loss_start < w.loss_stop <= w.stop <= home.stop
        assert w.stop - w.start <= inner + 2 * margin
        assert int(w.carries_loss().sum()) == w.loss_stop - w.loss_start
        assert w.start == home.start or w.loss_start - w.start == min(margin, w.loss_start - home.start)


def test_validation_frames_come_from_the_end_and_touch_no_training_frame() -> None:
    train_spans, held_out = split_validation([Span(0, 1000), Span(1000, 1050)], 0.1, 10)
    assert train_spans == [Span(0, 890), Span(1000, 1050)]
    assert held_out == [(Span(890, 1000), 10)]


def test_learning_beats_the_mean_tenfold_on_held_out_frames() -> None:
    seen: list[Progress] = []
    model, _, validation, mean = train(QUICK, progress=seen.append)
    assert validation < 0.1 * mean
    assert seen[-1].epoch == len(seen)
    assert all(p.eta_seconds >= 0 for p in seen)
    assert validation == min(p.validation_mse for p in seen)
    # The model holds the best weights, not the last: its own predictions give the reported error.
    flow, states = video_and_states()
    _, held_out = split_validation(FRAGMENTS, QUICK.validation_share, QUICK.margin)
    errors = []
    for span, context in held_out:
        predicted = predict_span(model, flow, span, 512)["humanoid_state"][context:]
        errors.append((model.normalise(predicted) - model.normalise(states[span.start + context : span.stop])).square())
    assert torch.cat(errors).mean().item() == pytest.approx(validation, rel=1e-4)


def test_equal_seeds_give_equal_weights() -> None:
    few = replace(QUICK, epochs=3)
    (a, history_a, *_), (b, history_b, *_) = train(few), train(few)
    assert history_a == history_b
    for key, value in a.state_dict().items():
        assert torch.equal(value, b.state_dict()[key]), key
    assert train(replace(few, seed=1))[1] != history_a


def test_resumed_training_is_the_same_training() -> None:
    saved: list[State] = []
    whole, history, validation, mean = train(replace(QUICK, epochs=6, save_every=3), save=saved.append)
    assert len(saved) == 3
    assert all(isinstance(v, Tensor) for v in saved[0].values())
    again, history_again, validation_again, mean_again = train(
        replace(QUICK, epochs=6, save_every=3), resume={k: v.clone() for k, v in saved[0].items()}
    )
    assert (history_again, validation_again, mean_again) == (history, validation, mean)
    for key, value in whole.state_dict().items():
        assert torch.equal(value, again.state_dict()[key]), key


def test_a_state_of_another_model_is_refused() -> None:
    saved: list[State] = []
    train(replace(QUICK, epochs=1), save=saved.append)
    with pytest.raises(InputError, match="another shape"):
        train(replace(QUICK, epochs=1, context_size=16), resume=saved[0])


def test_training_stops_when_patience_ends() -> None:
    flow, states = video_and_states()
    noise = torch.randn(states.shape, generator=torch.Generator().manual_seed(0))  # nothing to learn but by heart
    settings = replace(QUICK, schedule="constant", weight_decay=0.0, patience=3)
    result = train_regressor(build(settings, noise), flow, noise, FRAGMENTS, settings)
    assert len(result.history) == result.best_epoch + 3 < settings.epochs


def test_without_validation_the_last_weights_are_kept() -> None:
    settings = replace(QUICK, validation_share=0.0, patience=None, epochs=2, ema_decay=0.0)
    saved: list[State] = []
    model, _, validation, mean = train(settings, save=saved.append)
    assert math.isnan(validation)
    assert math.isnan(mean)
    for key, value in model.state_dict().items():
        assert torch.equal(value, saved[-1][f"model/{key}"]), key


def test_threads_are_as_they_were() -> None:
    before = torch.get_num_threads()
    train(replace(QUICK, epochs=1, threads=before + 1))
    assert torch.get_num_threads() == before


def test_predictions_fill_the_takes_and_the_causal_form_keeps_its_word() -> None:
    flow, states = video_and_states()
    model = build(QUICK, states)
    takes = [Span(0, 300), Span(400, 1000)]
    tables = predict_takes(model, flow, takes, QUICK)
    assert {k: tuple(v.shape) for k, v in tables.items()} == {
        "visual_features": (1500, 32),
        "visual_context": (1500, 64),
        "humanoid_state": (1500, 21),
    }
    assert not tables["humanoid_state"][300:400].any()
    direct = model(flow[None, 400:1000])
    torch.testing.assert_close(tables["humanoid_state"][400:1000], direct["humanoid_state"][0], atol=1e-4, rtol=1e-4)
    causal = predict_takes(model, flow, takes, QUICK, causal=True)
    changed = flow.clone()
    changed[200:300] += 1
    again = predict_takes(model, changed, takes, QUICK, causal=True)
    same = (causal["humanoid_state"] == again["humanoid_state"]).all(-1)
    assert same[: 200 - QUICK.lookahead].all()
    assert not same[200 - QUICK.lookahead : 300].any()


def test_mirrored_training_makes_mirrored_predictions() -> None:
    """A mirror under which the problem is symmetric: half the data still teaches both sides."""
    flow, states = video_and_states()
    mirror = StateMirror(torch.arange(21), -torch.ones(21))
    model = build(QUICK, states)
    one_step = replace(QUICK, mirror=True, epochs=3)
    train_regressor(model, flow, states, FRAGMENTS, one_step, mirror=mirror)
    unseen = mirror.flow(flow)
    mirrored = predict_takes(model, unseen, FRAGMENTS, QUICK)["humanoid_state"]
    plain = build(QUICK, states)
    train_regressor(plain, flow, states, FRAGMENTS, replace(one_step, mirror=False))
    unmirrored = predict_takes(plain, unseen, FRAGMENTS, QUICK)["humanoid_state"]
    truth = mirror.state(states)
    assert (mirrored - truth).square().mean() < (unmirrored - truth).square().mean()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"optimiser": "sgd"}, "optimiser"),
        ({"schedule": "linear"}, "schedule"),
        ({"margin": 60}, "margin"),
        ({"validation_share": 0.7}, "validation_share"),
        ({"validation_share": 0.0}, "patience"),
    ],
)
def test_wrong_settings_are_named(change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError) as error:
        replace(QUICK, **change)
    assert error.value.field == field


def test_wrong_inputs_are_named() -> None:
    flow, states = video_and_states()
    model = build(QUICK, states)
    for arguments, field in (
        ((flow[:-1], states, FRAGMENTS, QUICK), "flow"),
        ((flow, states, [], QUICK), "fragments"),
        ((flow, states, [Span(0, 2000)], QUICK), "fragments"),
        ((flow, states, FRAGMENTS, replace(QUICK, mirror=True)), "mirror"),
    ):
        with pytest.raises(InputError) as error:
            train_regressor(model, *arguments)
        assert error.value.field == field


def test_one_cycle_rises_and_ends_at_nothing() -> None:
    rates = [learning_rate_at(QUICK, x / 100) for x in range(101)]
    assert max(rates) == pytest.approx(QUICK.learning_rate)
    assert rates[0] < 0.1 * QUICK.learning_rate
    assert rates[-1] == pytest.approx(0.0, abs=1e-12)


@hypothesis_settings(max_examples=50, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 400), min_size=1, max_size=5), folds=st.integers(2, 6), margin=st.integers(0, 12)
)
def test_cross_fitting_covers_every_frame_once_and_never_learns_what_it_predicts(
    lengths: list[int], folds: int, margin: int
) -> None:
    ends = np.cumsum([0, *(n + 3 for n in lengths)])
    fragments = [Span(int(a), int(a) + n) for a, n in zip(ends[:-1], lengths, strict=True)]
    blocks = cross_fit_blocks(fragments, folds)
    frames = [t for block in blocks for span in block for t in range(span.start, span.stop)]
    assert sorted(frames) == [t for f in fragments for t in range(f.start, f.stop)]
    for block in blocks:
        learned = {t for s in without_block(fragments, block, margin, 10) for t in range(s.start, s.stop)}
        assert learned <= set(frames)
        for span in block:
            assert not learned & set(range(span.start, span.stop))
