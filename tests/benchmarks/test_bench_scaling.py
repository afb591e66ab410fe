"""The benchmarks of features and scaling, and the model of many cores."""

from __future__ import annotations

import importlib.util
import json
import mmap
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egopose import bench
from egopose.benchmarks import features
from egopose.benchmarks.process_memory import mapped_mb, private_mb, proportional_mb

SIMULATION = Path(__file__).parents[2] / "experiments" / "scaling" / "simulate.py"
COST: dict[str, Any] = {
    "num_envs": 32,
    "epochs": 5,
    "steps_per_iteration": 8192,
    "physics_s": 1e-4,
    "physics_cv": 0.0,
    "frame_bytes": 1000.0,
    "exchange_bytes": 0.0,
    "weights_bytes": 0.0,
    **dict.fromkeys(("python_fixed_s", "python_world_s", "policy_fixed_s", "policy_world_s"), 0.0),
    **dict.fromkeys(("join_s", "pack_s", "unpack_s", "weights_s", "exchange_s", "gae_s", "update_s"), 0.0),
}


@pytest.fixture(scope="module")
def model() -> Any:
    spec = importlib.util.spec_from_file_location("simulate", SIMULATION)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["simulate"] = module
    spec.loader.exec_module(module)
    return module


def test_without_other_costs_cores_multiply(model: Any) -> None:
    for cores in (1, 16, 64):
        rate, shares = model.in_step(COST, model.growing_batch(COST, cores))
        assert rate == pytest.approx(cores / 1e-4)
        assert shares["collect"] == 1.0


def test_the_update_bounds_any_number_of_cores(model: Any) -> None:
    cost = {**COST, "update_s": 1e-5}
    limit = 1 / (5 * 1e-5)
    rates = [model.in_step(cost, model.growing_batch(cost, cores))[0] for cores in (1, 16, 1024)]
    # By hand: a frame takes 100 us over the cores and 50 us of the learner.
    assert rates == pytest.approx([1 / 150e-6, 1 / (100e-6 / 16 + 50e-6), 1 / (100e-6 / 1024 + 50e-6 + 8e-7)], rel=1e-3)
    assert max(rates) < limit


def test_the_slowest_worker_holds_the_others_up(model: Any) -> None:
    cost = {**COST, "physics_cv": 0.2, "frame_bytes": 0.0}
    rates = [model.in_step(cost, model.growing_batch(cost, cores))[0] / cores for cores in (1, 64, 1024)]
    assert rates[0] > rates[1] > rates[2] > 0.9 / 1e-4


def test_measured_costs_give_the_published_table(model: Any) -> None:
    cost = json.loads((SIMULATION.parent / "measured.json").read_text())
    assert (SIMULATION.parent / "table.md").read_text() == model.table(cost)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_tells_reading_a_file_from_altering_it(tmp_path: Path) -> None:
    file = tmp_path / "table.bin"
    file.write_bytes(np.arange(2**18, dtype=np.int64).tobytes())  # 2 MiB
    os.sync()
    with file.open("r+b") as stream, mmap.mmap(stream.fileno(), 0, flags=mmap.MAP_PRIVATE) as mapped:
        table = np.frombuffer(mapped, dtype=np.int64)
        assert table.sum() > 0
        resident, altered = mapped_mb(os.getpid(), file)
        assert resident == pytest.approx(2.0)
        assert altered == 0.0
        np.frombuffer(mapped, dtype=np.int64)[: 2**17] = 7  # copies one MiB
        assert mapped_mb(os.getpid(), file)[1] == pytest.approx(1.0)
        del table
    assert 0 < private_mb(os.getpid()) < proportional_mb(os.getpid())


def test_features_are_measured_beside_decoding(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "_FRAMES", 90)
    bench.main(["features", "--json", "--rounds", "1"])
    result = json.loads(capsys.readouterr().out)
    assert result["ratio"] == pytest.approx(result["frames_per_s"] / result["decode_frames_per_s"])
    assert 0 < result["ratio"] < 1
    ways = 1 / result["flow_frames_per_s"] + 1 / result["encode_frames_per_s"]
    assert result["frames_per_s"] == pytest.approx(1 / ways)
    assert (result["size"], result["vision"], result["frames"]) == (128, "light", 90)
