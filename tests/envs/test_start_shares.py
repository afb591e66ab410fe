"""Groups of takes have at most their share of the frames that training episodes see."""

from __future__ import annotations

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.envs.start_shares import StartShares
from egopose.envs.starts import AdaptiveStarts, AdaptiveStartSettings, Piece, UniformStarts, training_starts

#: Two takes of a large set, two short ones of a small set; one of these too short for a whole episode.
LENGTHS = torch.tensor([900, 700, 120, 15])
OFFSETS = torch.tensor([0, 900, 1600, 1720])
GROUPS = ("tennis", "tennis", "cmu", "cmu")
PIECES = [Piece(take, 0, int(length)) for take, length in enumerate(LENGTHS)]


def shares(**largest: float) -> StartShares:
    return StartShares(GROUPS, largest)


def seen(starts: UniformStarts, draws: int = 200_000) -> torch.Tensor:
    """``[4]`` share of the frames of each take in episodes that nothing ends."""
    drawn = starts(torch.arange(draws), torch.Generator().manual_seed(1))
    frames = torch.zeros(4, dtype=torch.float64)
    frames.index_add_(0, drawn.take, (drawn.stop - drawn.start).double())
    inside = (drawn.start >= OFFSETS[drawn.take]) & (drawn.stop <= (OFFSETS + LENGTHS)[drawn.take])
    assert inside.all()
    return frames / frames.sum()


@pytest.mark.parametrize("minimum", [2, 20, 40])
@pytest.mark.parametrize("largest", [0.1, 0.4])
def test_a_group_has_its_share_of_the_frames_that_episodes_see(minimum: int, largest: float) -> None:
    starts = UniformStarts(PIECES, OFFSETS, LENGTHS, 40, minimum, shares(tennis=largest))
    before, after = seen(UniformStarts(PIECES, OFFSETS, LENGTHS, 40, minimum)), seen(starts)
    assert before[:2].sum() > 0.8
    assert after[:2].sum() == pytest.approx(largest, abs=0.01)
    # Within a group each start is as likely as any other: counted one by one.
    counted = [
        sum(min(40, length - start) for start in range(max(length - minimum + 1, 1))) for length in LENGTHS.tolist()
    ]
    assert float(after[0] / after[1]) == pytest.approx(counted[0] / counted[1], rel=0.05)
    assert float(after[2] / after[3]) == pytest.approx(counted[2] / counted[3], rel=0.1)


def test_starts_of_one_take_stay_uniform() -> None:
    starts = UniformStarts(PIECES, OFFSETS, LENGTHS, 40, 40, shares(tennis=0.4))
    drawn = starts(torch.arange(200_000), torch.Generator().manual_seed(0))
    frames, counts = drawn.start[drawn.take == 2].unique(return_counts=True)
    assert frames.equal(torch.arange(1600, 1681))
    assert (counts / counts.sum() - 1 / 81).abs().max() < 0.002


def test_a_group_below_its_limit_keeps_what_it_has() -> None:
    free, limited = (seen(UniformStarts(PIECES, OFFSETS, LENGTHS, 40, 20, s)) for s in (None, shares(cmu=0.5)))
    assert limited == pytest.approx(free, abs=0.01)


def test_without_shares_the_same_starts_are_drawn_as_ever() -> None:
    """Runs from before there were shares go on with the numbers they had."""
    starts = training_starts(None, PIECES, OFFSETS, LENGTHS, 40, 20)
    drawn = starts(torch.arange(50), torch.Generator().manual_seed(5))
    choices = torch.tensor([881, 681, 101, 1])
    pick = torch.randint(int(choices.sum()), (50,), generator=torch.Generator().manual_seed(5))
    within = pick - (choices.cumsum(0) - choices)[torch.searchsorted(choices.cumsum(0), pick, right=True)]
    assert (drawn.start - OFFSETS[drawn.take]).equal(within)


def test_adaptive_starts_keep_to_the_share_whatever_they_learn() -> None:
    settings = AdaptiveStartSettings(bin=10, unit=3.0, rate=0.5, floor=0.2)
    starts = AdaptiveStarts(PIECES, OFFSETS, LENGTHS, 40, 40, settings, shares(tennis=0.4))
    assert seen(starts)[:2].sum() == pytest.approx(0.4, abs=0.01)
    begun = torch.arange(1600, 1680)
    for _ in range(10):  # nothing of tennis is tried, all else is easy: tennis becomes urgent
        starts.ended(begun, torch.full_like(begun, 40), torch.zeros_like(begun, dtype=torch.bool))
    assert seen(starts)[:2].sum() == pytest.approx(0.4, abs=0.01)
    assert starts.probability.sum() == pytest.approx(1.0)


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 1000), st.integers(1, 50)), min_size=2, max_size=12),
    st.floats(0.01, 0.99),
    st.floats(0.01, 0.99),
)
def test_no_limit_is_passed_and_nothing_is_lost(rows: list[tuple[str, int, int]], a: float, b: float) -> None:
    groups = [row[0] for row in rows]
    assume({"a", "b"} <= set(groups))
    weight, frames = (torch.tensor([row[k] for row in rows], dtype=torch.float64) for k in (1, 2))
    limited = StartShares(groups, {"a": a, "b": b})
    if "c" not in groups and a + b < 1 - 1e-9:  # nothing could make up the rest
        with pytest.raises(InputError, match="a, b"):
            limited(weight, torch.arange(len(rows)), frames)
        return
    assume("c" in groups or a + b > 1 + 1e-9)
    out = limited(weight, torch.arange(len(rows)), frames)
    share = out * frames / (out * frames).sum()
    for group, limit in (("a", a), ("b", b)):
        mine = torch.tensor([g == group for g in groups])
        assert share[mine].sum() <= limit + 1e-9
        lowered = (out / weight)[mine]
        assert lowered == pytest.approx(float(lowered[0]))
        # Lowered only as far as the limit asks.
        assert lowered[0] == pytest.approx(1.0) or share[mine].sum() == pytest.approx(limit)
    assert (out > 0).all()
    assert (out / weight <= 1 + 1e-9).all()


@pytest.mark.parametrize(
    ("largest", "said"),
    [
        ({"tennis": 1.0}, "data.shares: tennis: must lie above 0 and below 1, not 1.0"),
        ({"tennis": "half"}, "data.shares: tennis: must be float, not 'half'"),
        ({"golf": 0.4}, "golf: no take belongs to this group; there are cmu, tennis"),
        ([0.4], "must be {GROUP: SHARE}"),
    ],
)
def test_a_wrong_share_is_refused(largest: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        StartShares(GROUPS, largest)


def test_limits_that_leave_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="cmu, tennis: all that is trained on is at its limit"):
        UniformStarts(PIECES, OFFSETS, LENGTHS, 40, 20, shares(tennis=0.4, cmu=0.4))
