"""N copies of one model, stepped together on a few threads."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.integer] | slice | list[int]

_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
# A world's clock starts here, not at zero: MuJoCo's answer to a state it cannot step is to reset the world in silence,
# which sets its time to zero. A clock that is not where the steps should have brought it tells.
_CLOCK_START = 1.0


class _Poses(NamedTuple):
    """``xpos [N, B, 3]`` m, ``xquat [N, B, 4]``, ``xipos [N, B, 3]`` m."""

    xpos: Array
    xquat: Array
    xipos: Array


class _Worker:
    """What one thread steps worlds with."""

    def __init__(self, model: mujoco.MjModel, substeps: int, body_ids: NDArray[np.integer]) -> None:
        self.data = data = mujoco.MjData(model)
        self._model, self._substeps = model, substeps
        # Views into the data: each attribute of MjData is made anew when it is asked for.
        self._qpos, self._ctrl, self._warm_start = data.qpos, data.ctrl, data.qacc_warmstart
        first, last = int(body_ids[0]), int(body_ids[-1])
        in_order = np.array_equal(body_ids, np.arange(first, last + 1))
        self._bodies = slice(first, last + 1) if in_order else body_ids
        self._poses = _Poses(data.xpos, data.xquat, data.xipos)
        self._warnings = data.warning.number

    def step(
        self,
        before: Array,
        ctrl: Array,
        worlds: Iterator[int],
        after: Array,
        poses: _Poses,
        warned: NDArray[np.bool_],
    ) -> None:
        """Take ``worlds`` from ``before`` to ``after`` ``[N, nstate]`` under ``ctrl [N, nu]``, until none is left."""
        model, data = self._model, self.data
        for i in worlds:
            mujoco.mj_setState(model, data, before[i], _FULL)
            self._ctrl[:], self._warm_start[:] = ctrl[i], 0.0
            mujoco.mj_step(model, data, self._substeps)
            mujoco.mj_getState(model, data, after[i], _FULL)
            warned[i] = self._warnings.any()
            if warned[i]:
                self._warnings[:] = 0
            self._place(i, poses)

    def pose(self, qpos: Array, world: int, poses: _Poses) -> None:
        """The poses of ``world`` at ``qpos [nq]``."""
        self._qpos[:] = qpos
        self._place(world, poses)

    def _place(self, world: int, poses: _Poses) -> None:
        # What a step leaves in the data is one substep old.
        mujoco.mj_kinematics(self._model, self.data)
        for there, here in zip(poses, self._poses, strict=True):
            there[world] = here[self._bodies]


class BatchedPhysics:
    """N worlds of one model, one control held over ``substeps`` steps of physics.

    A step is a function of (qpos, qvel, other state, ctrl) alone: the constraint solver starts cold at every control
    step, so results do not depend on the number of threads or on which one took which world, and a saved state resumes
    to the bit. (A warm start across control steps gained 0.4 %.)

    ``mj_step`` releases Python's lock for all substeps of a world, so plain threads take worlds in turn, the caller's
    own among them, each with one ``MjData`` that stays in its core's cache. Unlike ``mujoco.rollout`` that leaves the
    kinematics of the new state to be had at once, in the same threads.

    A world *diverges* when its state is not finite, a velocity is beyond ``max_speed``, its control is not finite, or
    MuJoCo warned and reset or stopped it. Its recent states go to a file, it is put back at its last sound state at
    rest, and :attr:`diverged` says so until the next step.

    Args:
        model: compiled; shared, not copied, never changed.
        n_worlds: N.
        substeps: steps of physics a control step.
        threads: the caller's and ``threads - 1`` more.
        body_ids: ``[B]`` bodies whose pose and mass make up the body state; default all but the world.
        max_speed: m/s and rad/s beyond which a velocity is absurd.
        dump_dir: where the last states of diverged worlds go (``<step>_<world>.npz``), None for nowhere.
        history: how many control steps are remembered for that.
        max_dumps: files written at most, so that a broken model cannot fill the disk.

    Raises:
        ValueError: counts that are not positive.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        n_worlds: int,
        substeps: int,
        threads: int = 1,
        *,
        body_ids: NDArray[np.integer] | None = None,
        max_speed: float = 1e3,
        dump_dir: str | Path | None = None,
        history: int = 8,
        max_dumps: int = 32,
    ) -> None:
        if min(n_worlds, substeps, threads, history) < 1:
            raise ValueError("n_worlds, substeps, threads and history must be at least 1")
        self.model, self.n_worlds, self.substeps, self.threads = model, n_worlds, substeps, threads
        self.body_ids = np.arange(1, model.nbody) if body_ids is None else np.asarray(body_ids)
        self._mass = model.body_mass[self.body_ids] / model.body_mass[self.body_ids].sum()
        self._max_speed = max_speed
        self._dump_dir, self._max_dumps = None if dump_dir is None else Path(dump_dir), max_dumps

        self._workers = [_Worker(model, substeps, self.body_ids) for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        size = mujoco.mj_stateSize(model, _FULL)
        self._qpos = slice(1, 1 + model.nq)
        self._qvel = slice(1 + model.nq, 1 + model.nq + model.nv)
        self._default = np.empty(size)
        mujoco.mj_getState(model, self._workers[0].data, self._default, _FULL)
        self._default[0] = _CLOCK_START
        #: ``[N, nstate]`` MuJoCo's full physics state of every world: time, qpos, qvel and the rest.
        self.state = np.tile(self._default, (n_worlds, 1))
        #: ``[N]`` worlds that diverged in the last step.
        self.diverged = np.zeros(n_worlds, dtype=bool)
        #: Worlds that diverged since the start.
        self.n_diverged = 0
        self.n_steps = 0
        self._past_states = np.tile(self._default, (history, n_worlds, 1))
        self._past_ctrl = np.zeros((history, n_worlds, model.nu))

        self._after = np.empty((n_worlds, size))
        self._warned = np.zeros(n_worlds, dtype=bool)
        self._poses = _Poses(
            np.empty((n_worlds, len(self.body_ids), 3)),
            np.empty((n_worlds, len(self.body_ids), 4)),
            np.empty((n_worlds, len(self.body_ids), 3)),
        )
        self._stale = np.ones(n_worlds, dtype=bool)

    @property
    def qpos(self) -> Array:
        """``[N, nq]`` view of the state."""
        return self.state[:, self._qpos]

    @property
    def qvel(self) -> Array:
        """``[N, nv]`` view of the state."""
        return self.state[:, self._qvel]

    def set_state(self, worlds: Indices, qpos: Array, qvel: Array) -> None:
        """Put ``worlds`` at ``qpos [n, nq]`` and ``qvel [n, nv]``, everything else as new."""
        self.state[worlds] = self._default
        self.state[worlds, self._qpos] = qpos
        self.state[worlds, self._qvel] = qvel
        self._stale[worlds] = True

    def step(self, ctrl: Array) -> NDArray[np.bool_]:
        """One control step of all worlds.

        Args:
            ctrl: ``[N, nu]``, held over the substeps.

        Returns:
            ``[N]`` worlds that diverged in it.

        Raises:
            ValueError: another shape.
        """
        if ctrl.shape != (self.n_worlds, self.model.nu):
            raise ValueError(f"ctrl must be [{self.n_worlds}, {self.model.nu}], got {list(ctrl.shape)}")
        slot = self.n_steps % len(self._past_states)
        self._past_states[slot], self._past_ctrl[slot] = self.state, ctrl
        after = self._step_all(ctrl)
        due = self.state[:, 0] + self.substeps * self.model.opt.timestep
        on_time = np.abs(after[:, 0] - due) < 0.5 * self.model.opt.timestep
        sound = on_time & ~self._warned & self._sound(self.state) & self._sound(after) & np.isfinite(ctrl).all(-1)
        self.diverged = ~sound
        self._stale[:] = self.diverged
        if sound.all():
            self.state[:] = after
        else:
            self._recover(slot, after)
        self.n_steps += 1
        return self.diverged

    def _step_all(self, ctrl: Array) -> Array:
        """``[N, nstate]`` after the substeps; fills the poses and :attr:`_warned`."""
        # One iterator for all threads: whoever is free takes the next world, so none waits longer than for one.
        worlds = iter(range(self.n_worlds))
        work = (self.state, ctrl, worlds, self._after, self._poses, self._warned)
        others = [] if self._pool is None else [self._pool.submit(w.step, *work) for w in self._workers[1:]]
        self._workers[0].step(*work)
        for other in others:
            other.result()
        return self._after

    def body_state(self) -> dict[str, Array]:
        """Fresh kinematics of all worlds, in new arrays.

        Positions that a step leaves behind in ``MjData`` are one substep old; these belong to the present qpos.

        Returns:
            ``qpos [N, nq]``, ``qvel [N, nv]``, ``xpos [N, B, 3]`` m, ``xquat [N, B, 4]``, ``com [N, 3]`` m.
        """
        for i in np.flatnonzero(self._stale).tolist():
            self._workers[0].pose(self.qpos[i], i, self._poses)
        self._stale[:] = False
        return {
            "qpos": self.qpos.copy(),
            "qvel": self.qvel.copy(),
            "xpos": self._poses.xpos.copy(),
            "xquat": self._poses.xquat.copy(),
            "com": self._mass @ self._poses.xipos,
        }

    def state_dict(self) -> dict[str, Array]:
        """All that a run needs to go on to the bit: ``state [N, nstate]`` and the counters."""
        counters = np.array([self.n_steps, self.n_diverged], dtype=np.float64)
        return {"state": self.state.copy(), "counters": counters}

    def load_state_dict(self, saved: dict[str, Array]) -> None:
        """Go on from :meth:`state_dict`.

        Raises:
            ValueError: it is of another number of worlds or another model.
        """
        if saved["state"].shape != self.state.shape:
            raise ValueError(f"state is {list(saved['state'].shape)}, this physics has {list(self.state.shape)}")
        self.state[:] = saved["state"]
        self.n_steps, self.n_diverged = (int(c) for c in saved["counters"])
        self._past_states[:], self._past_ctrl[:] = self.state, 0.0
        self._stale[:] = True

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _sound(self, state: Array) -> NDArray[np.bool_]:
        finite = np.isfinite(state).all(-1)
        with np.errstate(invalid="ignore"):
            slow = (np.abs(state[:, self._qvel]) < self._max_speed).all(-1)
        return np.logical_and(finite, slow)

    def _recover(self, slot: int, after: Array) -> None:
        """Record the diverged worlds and put them back at rest where they last were sound."""
        bad = np.flatnonzero(self.diverged)
        for i in bad:
            self._dump(int(i), slot, after[i])
        self.n_diverged += len(bad)
        last = np.where(self._sound(self.state)[:, None], self.state, self._default)
        self.state[:] = np.where(self.diverged[:, None], last, after)
        self.state[bad, self._qvel] = 0.0
        self.state[bad, 0] = _CLOCK_START

    def _dump(self, world: int, slot: int, after: Array) -> None:
        if self._dump_dir is None or self._max_dumps < 1:
            return
        self._max_dumps -= 1
        self._dump_dir.mkdir(parents=True, exist_ok=True)
        count = min(self.n_steps + 1, len(self._past_states))
        order = (slot + 1 - count + np.arange(count)) % len(self._past_states)
        states = np.concatenate([self._past_states[order, world], after[None]])
        np.savez(
            self._dump_dir / f"{self.n_steps:09d}_{world:05d}.npz",
            state=states,
            qpos=states[:, self._qpos],
            qvel=states[:, self._qvel],
            ctrl=self._past_ctrl[order, world],
        )
