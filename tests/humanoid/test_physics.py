"""Batched physics against plain MuJoCo, and what it does when a world diverges."""

from __future__ import annotations

import gc
import threading
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.humanoid_stand_in import stand_in

from egopose.humanoid.physics import BatchedPhysics
from egopose.humanoid.physics_worker import Worker


@pytest.fixture(scope="module")
def humanoid():
    return stand_in()


def started(humanoid, n: int, threads: int = 1, **kwargs) -> BatchedPhysics:
    physics = BatchedPhysics(humanoid.mj_model, n, humanoid.substeps, threads, **kwargs)
    qpos = np.tile(humanoid.mj_model.qpos0, (n, 1))
    qpos[:, 7:] = np.random.default_rng(0).uniform(-0.3, 0.3, (n, humanoid.mj_model.nu))
    physics.set_state(slice(None), qpos, np.zeros((n, humanoid.mj_model.nv)))
    return physics


def controls(humanoid, n: int, steps: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.5, 0.5, (steps, n, humanoid.mj_model.nu))


def test_steps_are_mujocos_own(humanoid) -> None:
    """Each world follows mj_step from the same state with a cold solver; poses are fresh, not a substep old."""
    model, physics = humanoid.mj_model, started(humanoid, 3, threads=2)
    worlds = [mujoco.MjData(model) for _ in range(3)]
    for i, data in enumerate(worlds):
        data.qpos[:] = physics.qpos[i]
    for ctrl in controls(humanoid, 3, 20):
        assert not physics.step(ctrl).any()
        state = physics.body_state()
        for i, data in enumerate(worlds):
            data.ctrl[:], data.qacc_warmstart[:] = ctrl[i], 0
            mujoco.mj_step(model, data, humanoid.substeps)
            np.testing.assert_array_equal(state["qpos"][i], data.qpos)
            np.testing.assert_array_equal(state["qvel"][i], data.qvel)
            fresh = mujoco.MjData(model)
            fresh.qpos[:] = data.qpos
            mujoco.mj_forward(model, fresh)
            np.testing.assert_allclose(state["xpos"][i], fresh.xpos[1:], atol=1e-12)
            np.testing.assert_allclose(state["xquat"][i], fresh.xquat[1:], atol=1e-12)
            np.testing.assert_allclose(state["com"][i], fresh.subtree_com[1], atol=1e-12)


def test_threads_do_not_matter(humanoid) -> None:
    one, two = started(humanoid, 7, threads=1), started(humanoid, 7, threads=2)
    for ctrl in controls(humanoid, 7, 15):
        one.step(ctrl)
        two.step(ctrl)
    np.testing.assert_array_equal(one.state, two.state)


def test_parts_of_the_worlds_may_be_under_way_together(humanoid) -> None:
    """Ranges that no thread's share divides, two begun before the first is waited for: the same to the bit."""
    whole, parts = started(humanoid, 21), started(humanoid, 21, threads=2)
    ranges = (slice(0, 13), slice(13, 21))
    for ctrl in controls(humanoid, 21, 4):
        whole.step(ctrl)
        for worlds in ranges:
            parts.begin_step(ctrl[worlds], worlds)
        for worlds in ranges:
            assert not parts.end_step(worlds).any()
    np.testing.assert_array_equal(whole.state, parts.state)
    np.testing.assert_array_equal(whole.body_state()["xpos"][13:], parts.body_state(ranges[1])["xpos"])
    parts.close()


def test_a_threads_error_reaches_who_waits(humanoid, monkeypatch) -> None:
    physics, ctrl = started(humanoid, 4, threads=2), controls(humanoid, 4, 1)[0]
    with monkeypatch.context() as broken:
        broken.setattr(Worker, "step", lambda *_: 1 / 0)
        physics.begin_step(ctrl)
        with pytest.raises(ZeroDivisionError):
            physics.end_step()
        with pytest.raises(ZeroDivisionError):
            physics.step(ctrl)
    assert not physics.step(ctrl).any()


def test_threads_end_with_the_physics(humanoid) -> None:
    before = set(threading.enumerate())
    physics = started(humanoid, 4, threads=2)
    physics.begin_step(controls(humanoid, 4, 1)[0])
    physics.end_step()
    serving = set(threading.enumerate()) - before
    assert len(serving) == 2
    del physics
    gc.collect()
    for thread in serving:
        thread.join(5.0)
        assert not thread.is_alive()


def test_a_saved_state_resumes_to_the_bit(humanoid) -> None:
    ctrl = controls(humanoid, 4, 20)
    physics = started(humanoid, 4)
    for c in ctrl[:10]:
        physics.step(c)
    saved = physics.state_dict()
    other = BatchedPhysics(humanoid.mj_model, 4, humanoid.substeps)
    other.load_state_dict(saved)
    for c in ctrl[10:]:
        physics.step(c)
        other.step(c)
    np.testing.assert_array_equal(physics.state, other.state)
    assert other.n_steps == 20
    with pytest.raises(ValueError, match="state is"):
        BatchedPhysics(humanoid.mj_model, 5, humanoid.substeps).load_state_dict(saved)


@pytest.mark.parametrize("fault", ["nan position", "nan velocity", "absurd velocity", "nan control", "explosion"])
def test_a_diverged_world_is_caught_recorded_and_put_back(humanoid, fault: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT where it stands.
    physics = started(humanoid, 4, threads=2, dump_dir=tmp_path / "diverged", history=3)
    witness = started(humanoid, 4, threads=2)
    steps = controls(humanoid, 4, 8)
    for ctrl in steps[:5]:
        physics.step(ctrl)
        witness.step(ctrl)
    ctrl = steps[5].copy()
    if fault == "nan position":
        physics.qpos[2, 9] = np.nan
    elif fault == "nan velocity":
        physics.qvel[2, 0] = np.inf
    elif fault == "absurd velocity":
        physics.qvel[2, 7] = 1e6
    elif fault == "nan control":
        ctrl[2, 3] = np.nan
    else:  # Every substep sound at its start, MuJoCo's own reset in the middle.
        physics.qvel[2, 6:] = 900.0
        physics.qpos[2, 2] = 0.2
    assert physics.step(ctrl).tolist() == [False, False, True, False]
    witness.step(steps[5])
    assert physics.n_diverged == 1
    assert np.isfinite(physics.state).all()
    assert (physics.qvel[2] == 0).all()
    others = [0, 1, 3]
    np.testing.assert_array_equal(physics.state[others], witness.state[others])
    (file,) = (tmp_path / "diverged").iterdir()
    with np.load(file, allow_pickle=False) as record:
        assert record["qpos"].shape == (4, humanoid.mj_model.nq)
        assert record["ctrl"].shape == (3, humanoid.mj_model.nu)
    # Training goes on.
    assert not physics.step(steps[6]).any()
    assert not physics.diverged.any()


def test_dumps_are_bounded(humanoid, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    physics = started(humanoid, 4, dump_dir=tmp_path / "diverged", max_dumps=2)
    physics.qpos[:, 8] = np.nan
    assert physics.step(np.zeros((4, humanoid.mj_model.nu))).all()
    assert len(list((tmp_path / "diverged").iterdir())) == 2
    assert physics.n_diverged == 4


def test_wrong_shapes_are_refused(humanoid) -> None:
    physics = started(humanoid, 2)
    with pytest.raises(ValueError, match="ctrl must be"):
        physics.step(np.zeros((3, humanoid.mj_model.nu)))
    with pytest.raises(ValueError, match="at least 1"):
        BatchedPhysics(humanoid.mj_model, 0, 5)
