"""Collectors in other processes: whole batches on the newest weights, one normaliser's statistics, states kept."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.toy_problem import COLLECTOR, LOOP, SETTINGS, ToyEnv, networks
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tensordict import TensorDictBase
from torchrl.envs import Compose, RenameTransform, TransformedEnv

from egopose.collection import collectors
from egopose.collection.collectors import CollectorSettings, build_collector
from egopose.collection.moments import Moments, merge_states, without_counts
from egopose.collection.workers import Workers
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.envs.transforms import StateNormalizer
from egopose.training.loop import LoopSettings, Run, iterate
from egopose.training.ppo import PPO, PPOSettings

WORLDS, WORKERS, STEPS = 4, 2, 25
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray: pip install 'egopose[ray]'")
KINDS = ["multi_sync", pytest.param("ray", marks=needs_ray)]
ROWS = arrays(np.float64, st.tuples(st.integers(0, 9), st.just(3)), elements=st.floats(-1e4, 1e4, width=32))


def normalized_toy(worker: int) -> TransformedEnv:
    """The toy as the real environment is: a running normaliser; what it counts stays visible under ``raw``."""
    keep = RenameTransform(["humanoid_state"], ["raw"], create_copy=True)
    return TransformedEnv(ToyEnv(WORLDS, seed=worker), Compose(keep, StateNormalizer(4)))


def networks_of(seed: int) -> tuple[Any, Any]:
    torch.manual_seed(seed)
    return networks()


def make_run(folder: Path, kind: str, seed: int = 3) -> Run:
    actor, critic = networks_of(seed)
    loop = LoopSettings.from_config({**LOOP, "steps_per_iteration": WORKERS * WORLDS * STEPS})
    chosen = CollectorSettings.from_config({**COLLECTOR, "kind": kind, "num_envs": WORLDS, "workers": WORKERS})
    collector = build_collector(chosen, normalized_toy, actor, loop.steps_per_iteration)
    ppo = PPO(actor, critic, PPOSettings.from_config(SETTINGS))
    return Run(ppo, collector, loop, chosen, folder, {"task": {"name": "toy"}}, action_size=2)


class Recorder:
    """Passes batches on and keeps them, with the means the actor of that moment gives for them."""

    def __init__(self, run: Run) -> None:
        self.run, self.batches, self.expected = run, [], []

    def __iter__(self) -> Iterator[TensorDictBase]:
        for batch in self.run.collector:
            self.batches.append(batch.clone())
            with torch.no_grad():
                self.expected.append(self.run.ppo.actor.get_dist(batch.select(*self.run.ppo.actor.in_keys)).mean)
            yield batch


@pytest.mark.parametrize("kind", KINDS)
def test_three_iterations_with_workers(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One start of the processes, several looks at what they brought."""
    # Ray's workers find this module, whose environment they make, as any other program's: on the path.
    for folder in Path(__file__).parents[:2]:
        monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    run = make_run(tmp_path, kind)
    try:
        recorder = Recorder(run)
        batches = iter(recorder)
        for _ in range(3):
            iterate(run, batches)
        assert run.counters.frames == 3 * WORKERS * WORLDS * STEPS
        _pieces_are_whole_rows_in_time(recorder)
        _the_weights_are_the_newest(recorder)
        _workers_draw_different_actions(recorder)
        _statistics_are_those_of_one_process(recorder)
        _workers_normalise_alike(recorder)
    finally:
        run.collector.shutdown()


def _pieces_are_whole_rows_in_time(recorder: Recorder) -> None:
    for batch in recorder.batches:
        assert batch.shape == (WORKERS * WORLDS, STEPS)
        going = ~batch["next", "done"].squeeze(-1)[:, :-1]
        assert torch.equal(batch["next", "raw"][:, :-1][going], batch["raw"][:, 1:][going])


def _the_weights_are_the_newest(recorder: Recorder) -> None:
    """Those after the last update, and others than the first."""
    pairs = list(zip(recorder.batches, recorder.expected, strict=True))
    for batch, expected in pairs:
        torch.testing.assert_close(batch["loc"], expected)
    inputs = pairs[-1][0].select(*recorder.run.ppo.actor.in_keys)
    now, first = pairs[-1][0]["loc"], networks_of(3)[0].get_dist(inputs).mean
    assert (now - first).abs().max() > 1e-3


def _workers_draw_different_actions(recorder: Recorder) -> None:
    first, second = recorder.batches[0].chunk(WORKERS)
    noise = [(part["action"] - part["loc"]).flatten() for part in (first, second)]
    assert abs(float(torch.corrcoef(torch.stack(noise))[0, 1])) < 0.5


def _statistics_are_those_of_one_process(recorder: Recorder) -> None:
    one, collector = StateNormalizer(4), recorder.run.collector
    for batch in recorder.batches:
        one.update(batch["next", "raw"].reshape(-1, 4))
        one.update(batch["raw"][batch["episode_step"].squeeze(-1) == 0])
    for simulation in collector.simulation:  # resets after a worker's last step, which the next batch would show
        carrier = simulation["carrier"]
        one.update(carrier["raw"][carrier["episode_step"].squeeze(-1) == 0])
    state = collectors.transform_state(collector)
    (prefix,) = (key.removesuffix("count") for key in state if key.endswith("count"))
    assert int(state[f"{prefix}count"]) == int(one.count) > 3 * WORKERS * WORLDS * STEPS
    torch.testing.assert_close(state[f"{prefix}mean"], one.mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(state[f"{prefix}sum_of_squares"], one.sum_of_squares, rtol=1e-12, atol=0.0)


def _workers_normalise_alike(recorder: Recorder) -> None:
    """By the merged statistics: at the second batch's first step one line scales both workers' observations."""
    after = recorder.batches[1]["next"][:, 0]
    raw, seen = after["raw"].double(), after["humanoid_state"].double()
    inside = (seen.abs() < 5).all(-1)
    for feature in range(4):
        design = torch.stack([raw[inside, feature], torch.ones(int(inside.sum()), dtype=torch.float64)], 1)
        residual = design @ torch.linalg.lstsq(design, seen[inside, feature]).solution - seen[inside, feature]
        # Each worker has counted its own four rows first: 4 in 200.
        assert residual.abs().max() < 0.05


def test_a_run_with_workers_resumes_to_the_bit_when_they_are_in_step(tmp_path: Path) -> None:
    whole = make_run(tmp_path, "multi_sync")
    again = None
    try:
        batches = iter(whole.collector)
        iterate(whole, batches)
        saved = whole.save()
        iterate(whole, batches)
        again = make_run(tmp_path, "multi_sync", seed=99)
        again.restore(saved)
        iterate(again, iter(again.collector))
        for first, second in zip(whole.ppo.actor.parameters(), again.ppo.actor.parameters(), strict=True):
            assert torch.equal(first, second)
        for key, value in collectors.transform_state(whole.collector).items():
            assert torch.equal(value, collectors.transform_state(again.collector)[key]), key
        with pytest.raises(InputError, match="of 1 workers, this run has 2"):
            collectors.load_simulation_state(again.collector, {"worker0": {}})
    finally:
        whole.collector.shutdown()
        if again is not None:
            again.collector.shutdown()


def moments_of(rows: np.ndarray) -> Moments:
    counted = StateNormalizer(3)
    counted.update(torch.from_numpy(rows))
    return Moments(int(counted.count), counted.mean, counted.sum_of_squares)


@given(before=ROWS, first=ROWS, second=ROWS)
@settings(max_examples=60, deadline=None)
def test_moments_add_and_subtract_as_sets_of_rows_do(before: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    given_ = moments_of(before)
    workers = [given_ + moments_of(rows) for rows in (first, second)]
    merged = given_
    for worker in workers:
        merged = merged + (worker - given_)
    rows = np.concatenate([before, first, second])
    assert merged.count == len(rows)
    if len(rows):
        np.testing.assert_allclose(merged.mean, rows.mean(0), rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(merged.sum_of_squares, len(rows) * rows.var(0), rtol=1e-6, atol=1e-3)


def test_many_merges_do_not_lose_precision() -> None:
    """A thousand exchanges between four workers, a nearly constant feature among the three."""
    generator = np.random.default_rng(0)
    rows = generator.normal(size=(1000, 4, 8, 3)) * [1.0, 1e3, 1e-3] + [0.0, 1e4, 1e4]
    total = moments_of(np.zeros((0, 3)))
    for iteration in rows:
        states = [total + moments_of(part) for part in iteration]
        given_ = total
        for state in states:
            total = total + (state - given_)
    flat = rows.reshape(-1, 3)
    np.testing.assert_allclose(total.mean, flat.mean(0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(total.sum_of_squares, len(flat) * flat.var(0), rtol=1e-5)


def test_other_transforms_state_is_left_alone() -> None:
    counted = StateNormalizer(2)
    counted.update(torch.ones(3, 2))
    state = {f"transforms.1.{key}": value for key, value in counted.state_dict().items()}
    state |= {"transforms.0.scale": torch.full((2,), 7.0), "transforms.0.count": torch.tensor(5)}
    blank = without_counts(state)
    assert blank["transforms.0.count"] == 5
    assert blank["transforms.1.count"] == 0
    merged = merge_states(blank, [state, state], [blank, blank])
    assert merged["transforms.1.count"] == 6
    assert torch.equal(merged["transforms.0.scale"], state["transforms.0.scale"])


def test_every_collector_of_the_configuration_is_read() -> None:
    for name in ("sync", "multi_sync", "ray"):
        assert CollectorSettings.from_config(compose_config("train", [f"collector={name}"])["collector"]).kind == name
    with pytest.raises(InputError, match="must be one of sync, multi_sync, ray") as caught:
        CollectorSettings.from_config({**COLLECTOR, "kind": "threads"})
    assert caught.value.field == "kind"


def test_a_missing_ray_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'egopose\[ray\]'"):
        Workers(
            "ray",
            normalized_toy,
            networks()[0],
            workers=1,
            num_envs=WORLDS,
            steps_per_iteration=8,
            threads=1,
            cpus=1,
        )


@needs_ray
def test_a_cluster_that_is_not_there_is_one_clear_line() -> None:
    with pytest.raises(InputError, match="no Ray cluster answers") as caught:
        build_collector(
            CollectorSettings.from_config({**COLLECTOR, "kind": "ray", "address": "auto"}),
            partial(normalized_toy),
            networks()[0],
            8,
        )
    assert caught.value.field == "address"
