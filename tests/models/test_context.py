"""Context networks against brute force; the episode's context against direct computation."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from egopose.core.errors import InputError
from egopose.models import episode_context
from egopose.models.context import BidirectionalContext, ForwardContext
from egopose.models.episode_context import EpisodeContext, episode_context_module

LOOKAHEAD = 10


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def test_bidirectional_context_equals_torchs_own_bilstm() -> None:
    net = BidirectionalContext(12, 5)
    reference = nn.LSTM(12, 5, batch_first=True, bidirectional=True)
    for name, value in net.forward_lstm.named_parameters():
        getattr(reference, name).data.copy_(value.data)
    for name, value in net.backward_lstm.named_parameters():
        getattr(reference, f"{name}_reverse").data.copy_(value.data)
    x = torch.randn(3, 17, 12)
    torch.testing.assert_close(net(x), reference(x)[0])


def test_rows_of_unequal_length_are_as_if_alone() -> None:
    net = BidirectionalContext(12, 5)
    x, lengths = torch.randn(4, 20, 12), torch.tensor([20, 1, 7, 13])
    out = net(x, lengths)
    for row, n in enumerate(lengths):
        torch.testing.assert_close(out[row, :n], net(x[row : row + 1, :n])[0], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("frames", [1, 7, 40])
def test_causal_equals_rerunning_the_bilstm_on_what_was_seen(frames: int) -> None:
    net = BidirectionalContext(16, 8).double()
    x = torch.randn(2, frames, 16, dtype=torch.float64)
    causal = net.causal(x, LOOKAHEAD)
    for t in range(frames):
        brute = net(x[:, : t + LOOKAHEAD + 1])[:, t]
        assert (causal[:, t] - brute).abs().max() < 1e-6


def test_causal_does_not_see_past_its_lookahead() -> None:
    net = BidirectionalContext(16, 8)
    x = torch.randn(1, 40, 16)
    changed = x.clone()
    changed[:, 25] += 1.0
    differs = (net.causal(x, LOOKAHEAD) != net.causal(changed, LOOKAHEAD)).any(-1)[0]
    assert not differs[: 25 - LOOKAHEAD].any()
    assert differs[25 - LOOKAHEAD :].all()


def test_stream_steps_equal_the_causal_pass() -> None:
    net = BidirectionalContext(16, 8)
    x = torch.randn(2, 30, 16)
    state, outputs = None, []
    for t in range(30):
        context, state = net.causal_step(x[:, t : t + LOOKAHEAD + 1], state)
        outputs.append(context)
    torch.testing.assert_close(torch.stack(outputs, 1), net.causal(x, LOOKAHEAD), atol=1e-6, rtol=1e-5)


def test_forward_context_is_the_last_output() -> None:
    net = ForwardContext(16, 24)
    x = torch.randn(3, 30, 16)
    assert net(x).shape == (3, 24)
    torch.testing.assert_close(net(x), net.lstm(x)[1][0][0])


BOUNDS = torch.tensor([[0, 90], [90, 400]])


def make_context(**kwargs: int | None) -> EpisodeContext:
    return EpisodeContext(torch.randn(400, 16), BidirectionalContext(16, 8), BOUNDS, **{"horizon": 50, **kwargs})


def direct(context: EpisodeContext, start: int, frame: int) -> torch.Tensor:
    begin, end = BOUNDS[0] if start < 90 else BOUNDS[1]
    low, high = max(start - 10, int(begin)), min(start + 60, int(end))
    return context.context(context.features_table[None, low:high])[0, frame - low]


EPISODES = [(0, 0), (0, 49), (60, 89), (90, 95), (200, 230), (200, 231), (370, 399)]


@pytest.mark.parametrize("gradients", [True, False])
def test_episode_context_equals_direct_computation(gradients: bool) -> None:
    context = make_context()
    td = TensorDict({"episode_start": torch.tensor([[s] for s, _ in EPISODES])}, [len(EPISODES)])
    td["frame"] = torch.tensor([[f] for _, f in EPISODES])
    with torch.set_grad_enabled(gradients):
        out = episode_context_module(context)(td)["visual_context"]
    assert out.requires_grad == gradients
    for row, (start, frame) in zip(out, EPISODES, strict=True):
        torch.testing.assert_close(row, direct(context, start, frame), atol=1e-6, rtol=1e-5)


def test_episode_context_takes_time_batches() -> None:
    context = make_context()
    start = torch.tensor([[100], [300]])[:, None].expand(2, 5, 1)
    frame = start + torch.arange(5)[None, :, None]
    out = context(start, frame)
    assert out.shape == (2, 5, 16)
    torch.testing.assert_close(out[1, 3], direct(context, 300, 303), atol=1e-6, rtol=1e-5)


def test_gradient_equals_the_direct_ones() -> None:
    context = make_context()
    context(torch.tensor([[200]]), torch.tensor([[215]])).sum().backward()
    got = [p.grad.clone() for p in context.parameters()]
    context.zero_grad()
    direct(context, 200, 215).sum().backward()
    for g, p in zip(got, context.parameters(), strict=True):
        torch.testing.assert_close(g, p.grad)


@torch.no_grad()
def test_cache_computes_each_episode_once_and_forgets_when_parameters_change(monkeypatch: pytest.MonkeyPatch) -> None:
    context = make_context()
    computed: list[int] = []
    compute = context._compute
    monkeypatch.setattr(context, "_compute", lambda first, last: (computed.append(len(first)), compute(first, last))[1])
    for step in range(5):
        context(torch.tensor([[100], [100], [300]]), torch.tensor([[100], [101], [300]]) + step)
    assert computed == [2]
    context(torch.tensor([[100], [310]]), torch.tensor([[102], [311]]))
    assert computed == [2, 1]
    before = context(torch.tensor([[100]]), torch.tensor([[104]]))
    parameter = context.context.forward_lstm.weight_ih_l0
    for change in (lambda: parameter.add_(0.1), lambda: parameter.data.copy_(parameter.data + 1e-4)):
        change()
        after = context(torch.tensor([[100]]), torch.tensor([[104]]))
        assert not torch.equal(before, after)
        torch.testing.assert_close(after[0], direct(context, 100, 104), atol=1e-6, rtol=1e-5)
        before = after


@torch.no_grad()
def test_cache_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episode_context, "CACHED_FRAMES", 200)
    context = make_context()
    for start in range(100, 300, 10):
        out = context(torch.tensor([[start]]), torch.tensor([[start + 3]]))
        assert context._cache.used <= 200
        torch.testing.assert_close(out[0], direct(context, start, start + 3), atol=1e-6, rtol=1e-5)


@torch.no_grad()
def test_whole_take_and_causal_at_test_time() -> None:
    context = make_context(horizon=None)
    frame = torch.arange(90, 400)[:, None]
    start = torch.full_like(frame, 90)
    whole = context.context(context.features_table[None, 90:400])[0]
    torch.testing.assert_close(context(start, frame), whole, atol=1e-6, rtol=1e-5)
    context.lookahead = LOOKAHEAD
    causal = context.context.causal(context.features_table[None, 90:400], LOOKAHEAD)[0]
    torch.testing.assert_close(context(start, frame), causal, atol=1e-6, rtol=1e-5)


def test_wrong_frames_and_bounds_are_refused() -> None:
    context = make_context()
    for start, frame in ((100, 170), (100, 89)):
        with pytest.raises(InputError, match="frame"):
            context(torch.tensor([[start]]), torch.tensor([[frame]]))
    with pytest.raises(InputError, match="take_bounds"):
        EpisodeContext(torch.zeros(10, 16), BidirectionalContext(16, 8), torch.tensor([[0, 11]]))
