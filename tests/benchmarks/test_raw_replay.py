"""The comparison with raw ``mj_step`` counts the same steps on both sides."""

from __future__ import annotations

import subprocess
import sys

import mujoco
import numpy as np
import torch
from helpers.env_stand_in import environment
from torchrl.collectors import Collector

from egopose.benchmarks.raw_replay import RawReplay, StepRecorder, compare_with_raw
from egopose.core import torch_settings as runtime
from egopose.core.torch_settings import enable_onednn_matmul


def collector(env) -> Collector:
    size = env.action_spec.shape
    return Collector(
        env,
        lambda td: td.set("action", 0.1 * torch.randn(size)),
        frames_per_batch=env.batch_size[0] * 6,
        total_frames=-1,
        track_traj_ids=False,
    )


def test_rates_and_keys() -> None:
    env = environment(4, threads=2)
    loop = collector(env)
    result = compare_with_raw(iter(loop), env.physics, rounds=3)
    loop.shutdown()
    assert {"ratio", "cpu_ratio", "control_steps_per_s", "raw_steps_per_s", "substeps", "num_envs", "threads"} <= set(
        result
    )
    assert (result["num_envs"], result["threads"]) == (4, 2)
    # A batch of collection can never cost less than its physics by much; noise aside.
    assert 0 < result["ratio"] < 1.5


def test_the_raw_side_does_the_loops_own_work(monkeypatch) -> None:
    """Stepped from the recorded state with the recorded control, every world ends where the loop's did."""
    env = environment(3)
    recorder = StepRecorder(env.physics)
    env.rollout(5, lambda td: td.set("action", 0.1 * torch.randn(env.action_spec.shape)))
    ends: list[np.ndarray] = []
    step = mujoco.mj_step

    def spy(model, data, substeps):
        step(model, data, substeps)
        ends.append(data.qpos.copy())

    monkeypatch.setattr(mujoco, "mj_step", spy)
    replay = RawReplay(env.physics)
    assert replay.run(recorder.states, recorder.ctrls) > 0
    replay.close()
    assert len(ends) == 5 * 3
    nq = env.physics.model.nq
    for t in range(4):
        expected = recorder.states[t + 1][:, 1 : 1 + nq]
        np.testing.assert_allclose(np.stack(ends[3 * t : 3 * t + 3]), expected, atol=1e-4)


def test_the_runtime_is_prepared_before_torch() -> None:
    """Importing it must not import torch, or the settings come too late."""
    code = (
        "import sys, os; from egopose.core.runtime import prepare_runtime; prepare_runtime();"
        "assert 'torch' not in sys.modules; assert os.environ['OMP_WAIT_POLICY'] == 'PASSIVE'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_quick_products_keep_single_precision() -> None:
    """As numpy's double precision says, whichever library multiplies; bfloat16 would be off by 2e-3."""
    code = (
        "import torch; from egopose.core.torch_settings import enable_onednn_matmul; quick = enable_onednn_matmul();"
        "setting = torch.backends.mkldnn.matmul.fp32_precision; assert (setting == 'bf16') == quick, setting;"
        "a, b = torch.randn(500, 700), torch.randn(700, 300); exact = a.double().numpy() @ b.double().numpy();"
        "error = (((a @ b).numpy() - exact) ** 2).mean() ** 0.5 / exact.std(); assert error < 5e-6, error"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_products_of_fewer_digits_are_left_off(monkeypatch) -> None:
    before = torch.backends.mkldnn.matmul.fp32_precision
    monkeypatch.setattr(runtime, "_keeps_single_precision", lambda *sizes: False)
    assert not enable_onednn_matmul.__wrapped__()
    assert torch.backends.mkldnn.matmul.fp32_precision == before
