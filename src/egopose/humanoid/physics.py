"""N copies of one model, stepped together on a few threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any
from weakref import finalize

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.humanoid.boxes import Boxes
from egopose.humanoid.contact_sensors import ContactSensors
from egopose.humanoid.physics_worker import FULL, WORLDS_AT_ONCE, Arrival, Placer, Worker

Array = NDArray[np.float64]
Indices = NDArray[np.integer] | slice | list[int]
ALL = slice(None)

#: What a row of :attr:`BatchedPhysics.state` is to ``mj_setState``: without boxes, the full physics' state.
STATE = FULL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
#: Entries of :meth:`BatchedPhysics.state_dict` with a row for each world, where they are there.
PER_WORLD = ("state", "contacts", "torques")
# A world's clock starts here, not at zero: MuJoCo's answer to a state it cannot step is to reset the world in silence,
# which sets its time to zero. A clock that is not where the steps should have brought it tells.
_CLOCK_START = 1.0
_CALLS_A_THREAD = 2  # at least, where there are worlds enough: threads that began apart end together


@dataclass
class _Order:
    """Parts of the worlds to be stepped by some threads; ``done`` tells once, when the last of them is through."""

    parts: Iterator[slice]
    threads: int
    through: list[BaseException | None] = field(default_factory=list)
    done: SimpleQueue[None] = field(default_factory=SimpleQueue)


def _serve(calls: SimpleQueue[Callable[[], None] | None]) -> None:
    """What a thread does: an executor's bookkeeping would cost the thread that acts 30 microseconds a step."""
    while (call := calls.get()) is not None:
        call()
        del call  # or the thread would keep the physics while it waits


def _dismiss(calls: SimpleQueue[Callable[[], None] | None], threads: int) -> None:
    for _ in range(threads):
        calls.put(None)


class BatchedPhysics:
    """N worlds of one model, one control held over ``substeps`` steps of physics.

    A step is a function of (qpos, qvel, other state, ctrl) alone: the constraint solver starts cold at every control
    step, so results do not depend on the number of threads or on which one took which world, and a saved state resumes
    to the bit. (A warm start across control steps gained 0.4 %.)

    Plain threads take worlds in turn, a few at a time, the caller's own among them. Each has one ``mujoco.batch.Batch``
    of those few rows on a copy of the model, with one ``MjData`` that stays in its core's cache: it loads, steps and
    saves them without Python, whose lock a thread needs for some microseconds in as many milliseconds. (With the four
    calls a world of plain bindings, each of which lets go of the lock, threads spent 5 % more.) What positions a step
    leaves are one substep old, and ``Batch.step`` works fresh ones out with all else that follows from positions, 9
    microseconds a world: :meth:`body_state` has ``mj_kinematics`` alone, in 4.

    :meth:`begin_step` and :meth:`end_step` are the two halves of a :meth:`step` for some of the worlds: between them
    the caller can work for the others, and threads that are through with these worlds go on to those begun next.

    A world *diverges* when its state is not finite, a velocity is beyond ``max_speed``, its control is not finite, or
    MuJoCo warned and reset or stopped it. Its recent states go to a file, it is put back at its last sound state at
    rest, and :attr:`diverged` says so until the next step.

    A model may hold boxes (:func:`egopose.humanoid.boxes.with_boxes`). Their poses are part of each world's state:
    :meth:`place_boxes` sets them, and a body put elsewhere (:meth:`set_state`) finds them where they were.

    Args:
        model: compiled; shared, not copied, never changed.
        num_envs: N.
        substeps: steps of physics a control step.
        threads: that step worlds; in a whole :meth:`step` the caller's is one of them.
        body_ids: ``[B]`` bodies whose pose and mass make up the body state; default all but the world.
        max_speed: m/s and rad/s beyond which a velocity is absurd.
        dump_dir: where the last states of diverged worlds go (``<step>_<world>.npz``), None for nowhere.
        history: how many control steps are remembered for that.
        max_dumps: files written at most, so that a broken model cannot fill the disk.
        contacts: keep :attr:`floor_contacts` and :attr:`box_contacts`; costs nothing when off.
        torques: keep :attr:`torques`; costs nothing when off, and a tenth of a step when on.

    Raises:
        ValueError: counts that are not positive, or contacts of a model without contact sensors.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        substeps: int,
        threads: int = 1,
        *,
        body_ids: NDArray[np.integer] | None = None,
        max_speed: float = 1e3,
        dump_dir: str | Path | None = None,
        history: int = 8,
        max_dumps: int = 32,
        contacts: bool = False,
        torques: bool = False,
    ) -> None:
        if min(num_envs, substeps, threads, history) < 1:
            raise ValueError("num_envs, substeps, threads and history must be at least 1")
        self.model, self.num_envs, self.substeps, self.threads = model, num_envs, substeps, threads
        self._boxes = Boxes(model)
        all_ids = np.setdiff1d(np.arange(1, model.nbody), self._boxes.bodies)
        self.body_ids = all_ids if body_ids is None else np.asarray(body_ids)
        self._mass = model.body_mass[self.body_ids] / model.body_mass[self.body_ids].sum()
        self._max_speed = max_speed
        self._dump_dir, self._max_dumps = None if dump_dir is None else Path(dump_dir), max_dumps

        self._placer = Placer(model, self.body_ids)
        self._idle: SimpleQueue[Worker] = SimpleQueue()
        sensors = ContactSensors(model) if contacts else None
        for _ in range(threads):
            self._idle.put(Worker(model, substeps, sensors))
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._serving = False
        self._dismiss = finalize(self, _dismiss, self._calls, threads)
        self._begun: dict[int, _Order] = {}
        self._duration = substeps * model.opt.timestep
        size = mujoco.mj_stateSize(model, STATE)
        self._full = mujoco.mj_stateSize(model, FULL)
        self._qpos = slice(1, 1 + model.nq)
        self._qvel = slice(1 + model.nq, 1 + model.nq + model.nv)
        self._default = np.empty(size)
        mujoco.mj_getState(model, self._placer.data, self._default, STATE)
        self._default[0] = _CLOCK_START
        #: ``[N, nstate]`` MuJoCo's full physics state of every world (time, qpos, qvel and the rest), then the boxes'
        #: positions ``3 K`` and quaternions ``4 K``.
        self.state = np.tile(self._default, (num_envs, 1))
        #: ``[N]`` worlds that diverged in the last step.
        self.diverged = np.zeros(num_envs, dtype=bool)
        #: Worlds that diverged since the start.
        self.n_diverged = 0
        self._taken = np.zeros(num_envs, dtype=np.int64)
        self._past_states = np.tile(self._default, (history, num_envs, 1))
        self._past_ctrl = np.zeros((history, num_envs, model.nu))

        self._ctrl = np.zeros((num_envs, model.nu))
        self._contacts = None if sensors is None else np.zeros((num_envs, *sensors.shape), dtype=bool)
        self._torques = np.zeros((num_envs, model.nu)) if torques else None
        self._after = Arrival(
            np.empty((num_envs, size)),
            np.zeros(num_envs, dtype=bool),
            None if self._contacts is None else self._contacts.copy(),
            None if self._torques is None else self._torques.copy(),
        )

    @property
    def n_steps(self) -> int:
        """Control steps that every world has taken."""
        return int(self._taken.min())

    @property
    def taken(self) -> NDArray[np.int64]:
        """``[N]`` control steps each world has taken; the same in all but between the two halves of a step."""
        return self._taken.copy()

    @property
    def qpos(self) -> Array:
        """``[N, nq]`` view of the state."""
        return self.state[:, self._qpos]

    @property
    def qvel(self) -> Array:
        """``[N, nv]`` view of the state."""
        return self.state[:, self._qvel]

    @property
    def box_positions(self) -> Array:
        """``[N, K, 3]`` m, view of the state: the boxes' centres. :meth:`place_boxes` takes their upper faces'."""
        boxes = self.state[:, self._full : self._full + 3 * len(self._boxes)]
        return boxes.reshape(self.num_envs, len(self._boxes), 3)

    @property
    def box_tops(self) -> Array:
        """``[N, K, 3]`` m, centres of the boxes' upper faces."""
        return self._boxes.tops(self.box_positions)

    @property
    def box_quaternions(self) -> Array:
        """``[N, K, 4]`` view of the state."""
        return self.state[:, self._full + 3 * len(self._boxes) :].reshape(self.num_envs, len(self._boxes), 4)

    @property
    def floor_contacts(self) -> NDArray[np.bool_]:
        """``[N, E]`` which bodies touched the floor in the last substep of the last step; none in a world put anew.

        Raises:
            RuntimeError: made without ``contacts``.
        """
        return self._told(self._contacts, "contacts")[:, :, 0]

    @property
    def box_contacts(self) -> NDArray[np.bool_]:
        """``[N, E, K]`` which bodies touched which box, see :attr:`floor_contacts`."""
        return self._told(self._contacts, "contacts")[:, :, 1:]

    @property
    def torques(self) -> Array:
        """``[N, nu]`` N m on the actuated joints, within their limits: the mean over the substeps of the last step.

        The mean is what gave the joint its angular momentum in the step. The last substep's alone is off by half of it
        in a walk: an actuator pulls most when its target has just moved. Zero in a world put anew.

        Raises:
            RuntimeError: made without ``torques``.
        """
        return self._told(self._torques, "torques")

    @staticmethod
    def _told(kept: Any, name: str) -> Any:
        if kept is None:
            raise RuntimeError(f"this physics was made without {name}=True")
        return kept

    def set_state(self, worlds: Indices, qpos: Array, qvel: Array) -> None:
        """Put ``worlds`` at ``qpos [n, nq]`` and ``qvel [n, nv]``, everything else as new; boxes stay."""
        self.state[worlds, : self._full] = self._default[: self._full]
        self.state[worlds, self._qpos] = qpos
        self.state[worlds, self._qvel] = qvel
        self._forget(worlds)

    def place_boxes(self, worlds: Indices, top: Array, heading: Array, used: NDArray[np.bool_] | None = None) -> None:
        """Put the boxes of ``worlds``: see :meth:`egopose.humanoid.boxes.Boxes.poses` for the arguments.

        Raises:
            ValueError: a place where a box cannot be.
        """
        self.box_positions[worlds], self.box_quaternions[worlds] = self._boxes.poses(top, heading, used)

    def _forget(self, worlds: Indices) -> None:
        """Worlds that were put anew have touched nothing and exerted nothing."""
        for kept in (self._contacts, self._torques):
            if kept is not None:
                kept[worlds] = 0

    def step(self, ctrl: Array, worlds: slice = ALL) -> NDArray[np.bool_]:
        """One control step of ``worlds``, a range of them.

        Args:
            ctrl: ``[n, nu]`` of these worlds, held over the substeps.
            worlds: none of which is under way.

        Returns:
            ``[n]`` which of these worlds diverged in it.

        Raises:
            ValueError: another shape.
        """
        order = self._begin(ctrl, worlds)
        self._send(order, self.threads - 1)
        self._run(order)
        return self.end_step(worlds)

    def begin_step(self, ctrl: Array, worlds: slice = ALL) -> None:
        """Have the threads take a control step of ``worlds``, a range of them; :meth:`end_step` waits for it.

        Args:
            ctrl: ``[n, nu]`` of these worlds, held over the substeps.
            worlds: none of which is under way.

        Raises:
            ValueError: another shape.
        """
        self._send(self._begin(ctrl, worlds), self.threads)

    def end_step(self, worlds: slice = ALL) -> NDArray[np.bool_]:
        """Wait for what :meth:`begin_step` began; ``[n]`` which of these worlds diverged in it."""
        first = worlds.indices(self.num_envs)[0]
        order = self._begun.pop(first)
        order.done.get()
        for error in order.through:
            if error is not None:
                raise error
        before, after, ctrl = self.state[worlds], self._after.state[worlds], self._ctrl[worlds]
        on_time = np.abs(after[:, 0] - before[:, 0] - self._duration) < 0.5 * self._duration / self.substeps
        sound = (
            on_time & ~self._after.warned[worlds] & self._sound(before) & self._sound(after) & np.isfinite(ctrl).all(-1)
        )
        self.diverged[worlds] = ~sound
        for kept, new in ((self._contacts, self._after.contacts), (self._torques, self._after.torques)):
            if kept is not None and new is not None:
                kept[worlds] = new[worlds]
        if sound.all():
            before[:] = after
        else:
            before[sound] = after[sound]
            self._recover(first + np.flatnonzero(~sound))
        self._taken[worlds] += 1
        return ~sound

    def _begin(self, ctrl: Array, worlds: slice) -> _Order:
        first, last, _ = worlds.indices(self.num_envs)
        if ctrl.shape != (last - first, self.model.nu):
            raise ValueError(f"ctrl must be [{last - first}, {self.model.nu}], got {list(ctrl.shape)}")
        slot = self._taken[first] % len(self._past_states)
        self._past_states[slot, worlds], self._past_ctrl[slot, worlds] = self.state[worlds], ctrl
        self._ctrl[worlds] = ctrl
        # One iterator for all threads: whoever is free takes the next worlds, so none waits longer than for these.
        size = min(WORLDS_AT_ONCE, -(-(last - first) // (_CALLS_A_THREAD * self.threads)))
        parts = iter([slice(at, min(at + size, last)) for at in range(first, last, size)])
        order = self._begun[first] = _Order(parts, self.threads)
        return order

    def _send(self, order: _Order, threads: int) -> None:
        if threads and not self._serving:
            self._serving = True
            for _ in range(self.threads):
                Thread(target=_serve, args=(self._calls,), daemon=True).start()
        for _ in range(threads):
            self._calls.put(partial(self._run, order))

    def _run(self, order: _Order) -> None:
        worker, error = self._idle.get(), None
        try:
            worker.step(self.state, self._ctrl, order.parts, self._after)
        except BaseException as raised:  # of the thread that waits
            error = raised
        self._idle.put(worker)
        order.through.append(error)
        if len(order.through) == order.threads:
            order.done.put(None)

    def body_state(self, worlds: slice = ALL) -> dict[str, Array]:
        """Fresh kinematics of ``worlds``, in new arrays.

        Positions that a step leaves behind in ``MjData`` are one substep old; these belong to the present qpos.

        Returns:
            ``qpos [n, nq]``, ``qvel [n, nv]``, ``xpos [n, B, 3]`` m, ``xquat [n, B, 4]``, ``com [n, 3]`` m. With boxes
            ``box_tops [n, K, 3]`` m, the centres of their upper faces (far below the floor where parked), and
            ``box_quaternions [n, K, 4]``. What was asked for of ``floor_contacts``, ``box_contacts``, ``torques``.
        """
        qpos = self.qpos[worlds].copy()
        return {"qpos": qpos, "qvel": self.qvel[worlds].copy(), **self.poses(qpos), **self._scene(worlds)}

    def poses(self, qpos: Array) -> dict[str, Array]:
        """``xpos [n, B, 3]`` m, ``xquat [n, B, 4]`` and ``com [n, 3]`` m of bodies at ``qpos [n, nq]``, in no world."""
        xpos, xquat, xipos = self._placer(qpos)
        return {"xpos": xpos, "xquat": xquat, "com": self._mass @ xipos}

    def _scene(self, worlds: slice) -> dict[str, Any]:
        out: dict[str, Any] = {}
        if len(self._boxes):
            out["box_tops"] = self._boxes.tops(self.box_positions[worlds])
            out["box_quaternions"] = self.box_quaternions[worlds].copy()
        if self._contacts is not None:
            out["floor_contacts"] = self.floor_contacts[worlds].copy()
            out["box_contacts"] = self.box_contacts[worlds].copy()
        if self._torques is not None:
            out["torques"] = self._torques[worlds].copy()
        return out

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """All that a run needs to go on to the bit: ``state [N, nstate]``, boxes included, and the counters.

        Where asked for, also ``contacts [N, E, 1 + K]`` (the floor, then the boxes) and ``torques [N, nu]``.
        """
        counters = np.array([self.n_steps, self.n_diverged], dtype=np.float64)
        told = {"contacts": self._contacts, "torques": self._torques}
        kept = {name: values.copy() for name, values in told.items() if values is not None}
        return {"state": self.state.copy(), "counters": counters, **kept}

    def load_state_dict(self, saved: dict[str, NDArray[Any]]) -> None:
        """Go on from :meth:`state_dict`. Contacts and torques that were not saved are none until the next step.

        Raises:
            ValueError: it is of another number of worlds or another model.
        """
        if saved["state"].shape != self.state.shape:
            raise ValueError(f"state is {list(saved['state'].shape)}, this physics has {list(self.state.shape)}")
        self.state[:] = saved["state"]
        self._taken[:], self.n_diverged = (int(c) for c in saved["counters"])
        self._past_states[:], self._past_ctrl[:] = self.state, 0.0
        self._forget(ALL)
        for name, kept in (("contacts", self._contacts), ("torques", self._torques)):
            if kept is not None and name in saved:
                kept[:] = saved[name]

    def close(self) -> None:
        """Stop the threads."""
        self._dismiss()

    def _sound(self, state: Array) -> NDArray[np.bool_]:
        # The largest of numbers one of which is none is none, and not below anything.
        return (np.abs(state[:, self._qvel]).max(-1) < self._max_speed) & np.isfinite(state).all(-1)

    def _recover(self, bad: NDArray[np.integer]) -> None:
        """Record worlds ``bad``, which diverged, and put them back at rest where they last were sound."""
        for i in bad.tolist():
            self._dump(i)
        self.n_diverged += len(bad)
        before = self.state[bad]
        full = slice(self._full)  # boxes stay where they are
        self.state[bad, full] = np.where(self._sound(before)[:, None], before[:, full], self._default[full])
        self.state[bad, self._qvel] = 0.0
        self.state[bad, 0] = _CLOCK_START
        self._forget(bad)

    def _dump(self, world: int) -> None:
        if self._dump_dir is None or self._max_dumps < 1:
            return
        self._max_dumps -= 1
        self._dump_dir.mkdir(parents=True, exist_ok=True)
        taken = int(self._taken[world])
        count = min(taken + 1, len(self._past_states))
        order = (taken + 1 - count + np.arange(count)) % len(self._past_states)
        states = np.concatenate([self._past_states[order, world], self._after.state[world][None]])
        np.savez(
            self._dump_dir / f"{taken:09d}_{world:05d}.npz",
            state=states,
            qpos=states[:, self._qpos],
            qvel=states[:, self._qvel],
            ctrl=self._past_ctrl[order, world],
        )
