"""The command ``bench train``: whole iterations beside exactly the control steps they took."""

from __future__ import annotations

import json

import numpy as np
import pytest

from egopose import bench
from egopose.benchmarks.raw_replay import RawReplay

SMALL = ["sim=fast", "collector.num_envs=4", "algo.steps_per_iteration=32", "algo.minibatch_size=16", "algo.epochs=2"]


def test_iterations_are_timed_beside_their_own_control_steps(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    replayed: list[int] = []
    run = RawReplay.run

    def counted(replay: RawReplay, states: list[np.ndarray], ctrls: list[np.ndarray]) -> float:
        replayed.append(sum(len(one) for one in states))
        return run(replay, states, ctrls)

    monkeypatch.setattr(RawReplay, "run", counted)
    bench.main(["train", "--json", "--rounds", "2", *SMALL, "algo.autocast=bfloat16"])
    result = json.loads(capsys.readouterr().out)
    assert replayed == [32, 32]
    assert result["steps"] == 32
    assert result["gradient_steps"] == 2 * 32 // 16
    assert (result["epochs"], result["minibatch_size"], result["bfloat16"]) == (2, 16, True)
    assert (result["num_envs"], result["substeps"], result["threads"], result["rounds"]) == (4, 4, 2, 2)
    shares = [result[f"{part}_share"] for part in ("collect", "advantages", "update")]
    assert all(0 < share < 1 for share in shares)
    # Learning comes on top of the physics: at this size it is nearly all.
    assert 0 < result["of_raw"] < 0.9
    assert 0 < result["cpu_of_raw"] < 0.9


def test_a_wrong_setting_is_one_line(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        bench.main(["train", "algo.autocast=float16"])
    assert stop.value.code == 2
    assert "autocast" in capsys.readouterr().err
