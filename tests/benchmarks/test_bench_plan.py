"""The command ``bench plan``: what looking ahead costs beside exactly the control steps it simulated."""

from __future__ import annotations

import json

import numpy as np
import pytest

from egopose import bench
from egopose.benchmarks.raw_replay import RawReplay

SMALL = [
    "planner=ahead",
    "planner.samples=3",
    "planner.rounds=2",
    "planner.horizon=4",
    "planner.every=4",
    "planner.recovery_rounds=0",
]


def test_steps_of_some_worlds_count_as_many(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    replayed: list[int] = []
    monkeypatch.setattr(RawReplay, "run", lambda self, states, ctrls: replayed.append(sum(map(len, states))) or 1.0)
    words = ["planner=gauss_newton", "planner.samples=53", "planner.changed=3", "planner.horizon=4"]
    words += ["planner.every=4", "planner.recovery_rounds=0", "planner.dampings=[1,10]"]
    bench.main(["plan", "--json", "--rounds", "1", *words])
    # Derivatives of 52 hinges and the plan itself, then two steps beside the plan and none.
    assert json.loads(capsys.readouterr().out)["control_steps"] == 53 + 4
    assert replayed == [(53 + 4) * 32] * 2


def test_a_plan_is_timed_beside_the_control_steps_it_took(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    replayed: list[int] = []
    run = RawReplay.run

    def counted(replay: RawReplay, states: list[np.ndarray], ctrls: list[np.ndarray]) -> float:
        replayed.append(sum(len(one) for one in states))
        return run(replay, states, ctrls)

    monkeypatch.setattr(RawReplay, "run", counted)
    bench.main(["plan", "--json", "--rounds", "1", *SMALL])
    result = json.loads(capsys.readouterr().out)
    # Two rounds of three ways over four frames, once in four frames: six control steps a frame, for 32 frames.
    assert result["control_steps"] == 6
    assert replayed == [6 * 32] * 2  # one warms up
    assert result["rounds"] == 1
    assert result["ratio"] == pytest.approx(result["plan_ms"] / result["physics_ms"])
    assert result["ratio"] > 1
    assert result["cpu_ratio"] > 0


@pytest.mark.parametrize("word", ["planner.samples=2", "planner.smaples=9", "planner=none"])
def test_no_planner_or_a_wrong_one_is_one_line(word: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        bench.main(["plan", "--json", word])
    assert stop.value.code == 2
    assert "planner" in capsys.readouterr().err
