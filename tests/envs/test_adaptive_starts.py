"""Starts drawn the more often the sooner episodes begun near them fell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.env_stand_in import PIECES, environment, problem
from helpers.estimation_run import assert_equal, configuration, estimation_dataset

from egopose.core.errors import InputError
from egopose.envs.starts import AdaptiveStarts, AdaptiveStartSettings, training_starts
from egopose.pipeline.run import build_run
from egopose.training.loop import train

SETTINGS = {"bin": 5, "unit": 3.0, "rate": 0.5, "floor": 0.2}
STARTS = AdaptiveStartSettings(bin=5, unit=3.0, rate=0.5, floor=0.2)


def adaptive(settings: AdaptiveStartSettings = STARTS, horizon: int = 15) -> AdaptiveStarts:
    takes = problem().takes
    return AdaptiveStarts(PIECES, takes.offsets, takes.lengths, horizon, 8, settings)


def test_untried_starts_are_uniform_over_all_frames_that_leave_room() -> None:
    starts = adaptive()
    drawn = starts(torch.arange(20_000), torch.Generator().manual_seed(0))
    # 33 starts of the 40 frames of one piece, 13 of the 20 of the other, which begins at global frame 45.
    wanted = torch.cat([torch.arange(33), torch.arange(45, 58)])
    frames, counts = drawn.start.unique(return_counts=True)
    assert frames.equal(wanted)
    assert (counts.double() / 20_000 - 1 / len(wanted)).abs().max() < 0.005
    assert (
        drawn.stop == torch.where(drawn.start < 40, (drawn.start + 15).clamp_max(40), drawn.start + 15).clamp_max(65)
    ).all()
    assert drawn.take.equal((drawn.start >= 40).long())


def test_starts_of_quick_falls_are_drawn_more_often_and_none_vanishes() -> None:
    starts = adaptive()
    begun = torch.arange(33)
    for _ in range(20):
        starts.ended(begun, torch.where(begun < 5, 1, 14), begun < 5)
    probability = starts.probability
    torch.testing.assert_close(probability.sum(), torch.tensor(1.0, dtype=torch.float64))
    # By hand: bins of 5 frames, one survives 1 frame, the others of its piece the horizon (15); those of the other
    # piece were never tried. Weights 1 / (n / 3 + 1).
    size = torch.tensor([5.0] * 6 + [3.0] + [5.0] * 2 + [3.0], dtype=torch.float64)
    weight = size * torch.tensor([3 / 4] + [3 / 18] * 6 + [1.0] * 3, dtype=torch.float64)
    torch.testing.assert_close(probability, 0.2 * size / 46 + 0.8 * weight / weight.sum(), atol=1e-4, rtol=0)
    assert (probability >= 0.2 * size / 46).all()


def test_the_environment_tells_its_starts_how_episodes_ended() -> None:
    env = environment(6, starts={"kind": "adaptive", **SETTINGS})
    assert isinstance(env.starts, AdaptiveStarts)
    noted: list[tuple[int, int, bool]] = []
    note = env.starts.ended

    def listen(start: torch.Tensor, frames: torch.Tensor, fell: torch.Tensor) -> None:
        noted.extend(zip(start.tolist(), frames.tolist(), fell.tolist(), strict=True))
        note(start, frames, fell)

    env.starts.ended = listen  # type: ignore[method-assign]
    seen = []
    td = env.reset()
    for _ in range(30):
        td = td.set("action", torch.zeros(env.action_spec.shape))
        stepped, td = env.step_and_maybe_reset(td)
        after = stepped["next"]
        done = after["done"].squeeze(-1)
        rows = after[done]
        seen += zip(*(rows[k].flatten().tolist() for k in ("episode_start", "episode_step", "terminated")), strict=True)
    assert noted == seen
    assert len(seen) > 6
    assert env.starts.survived.any()


@pytest.mark.parametrize("env_groups", [1, 2])
def test_adaptive_starts_resume_to_the_bit(env_groups: int, tmp_path: Path) -> None:
    dataset = estimation_dataset()

    def make(name: str, seed: int = 5, **training: Any) -> Any:
        config = {**configuration(**training), "seed": seed}
        config["task"] = {**config["task"], "starts": {"kind": "adaptive", **SETTINGS}}
        config["collector"] = {**config["collector"], "env_groups": env_groups}
        return build_run(config, tmp_path / name, dataset)

    whole = make("whole")
    train(whole, [])
    outcome = train(make("half", iterations=2), [])
    again = make("half", seed=9)
    again.restore(outcome.checkpoint)
    train(again, [])
    for name in ("policy", "critic", "transforms", "simulation"):
        first, second = (run.checkpoint().components[name].state_dict() for run in (whole, again))
        assert_equal(first, second, name)
    assert "survived" in whole.checkpoint().components["simulation"].state_dict()["worlds"]


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"kind": "often"}, "task.starts: kind"),
        ({"kind": "uniform", "bin": 3}, "task.starts: kind"),
        ({"kind": "adaptive", **SETTINGS, "bin": 0}, "task.starts: bin"),
        ({"kind": "adaptive", **SETTINGS, "floor": 1.5}, "task.starts: floor"),
        ({"kind": "adaptive", "bin": 3}, "task.starts: unit"),
    ],
)
def test_wrong_starts_are_refused_by_name(settings: dict[str, Any], field: str) -> None:
    takes = problem().takes
    with pytest.raises(InputError, match=field):
        training_starts(settings, PIECES, takes.offsets, takes.lengths, 15, 8)
