"""The batched environment: N humanoids on N pieces of a task's reference, as one TorchRL ``EnvBase``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from egopose.envs.mdp.observations import BodyState, BodyView
from egopose.envs.mdp.path import lay, on_path, root_on_floor
from egopose.envs.mdp.step_view import Contacts, StepView
from egopose.envs.problem import BODY_KEYS, Problem
from egopose.envs.starts import Starts
from egopose.envs.target_motion import present_path
from egopose.humanoid.physics import ALL, Array, BatchedPhysics, Indices

Counter = NDArray[np.int64]

_STEPS_REWARDED_AT_ONCE = 8  # of all worlds: measured, at 64 worlds; twice or half as many are as quick


class _Unrewarded(NamedTuple):
    """What the reward of a step reads: body state, other parts, ``[N]`` frame, steps into the episode, diverged."""

    state: dict[str, Tensor]
    parts: dict[str, Tensor]
    frame: Tensor
    step: Tensor
    diverged: Tensor


def _joined(steps: list[_Unrewarded]) -> _Unrewarded:
    """Steps one after the other, as if of many worlds."""
    state, parts = (
        {key: torch.cat([row[key] for row in rows]) for key in rows[0]} for rows in list(zip(*steps, strict=True))[:2]
    )
    frame, step, diverged = (torch.cat(column) for column in list(zip(*steps, strict=True))[2:])
    return _Unrewarded(state, parts, frame, step, diverged)


def _step_parts(arrays: Mapping[str, Tensor]) -> dict[str, Any]:
    """Keyword arguments of a problem's ``step_view``."""
    parts: dict[str, Any] = {name: arrays[name] for name in ("torques", "target", "scene") if name in arrays}
    if "floor_contacts" in arrays:
        parts["contacts"] = Contacts(arrays["floor_contacts"], arrays["box_contacts"])
    return parts


def _scene(body: Mapping[str, Tensor]) -> Tensor:
    """``[n, K, 7]`` places and quaternions of the boxes; none where the worlds have none."""
    if "box_tops" not in body:
        return torch.zeros(len(body["qpos"]), 0, 7, dtype=torch.float64)
    return torch.cat([body["box_tops"], body["box_quaternions"]], dim=-1)


def _replaced(counter: Counter, rows: NDArray[np.integer] | slice, values: Counter) -> Counter:
    """A copy of ``counter`` with ``values`` in ``rows``."""
    counter = counter.copy()
    counter[rows] = values
    return counter


_DONE = ("done", "terminated", "truncated")


def _no_flags(endings: tuple[str, ...], size: torch.Size) -> dict[str, Tensor]:
    names = (*endings, "diverged", *_DONE)
    return dict(zip(names, torch.zeros(len(names), *size, 1, dtype=torch.bool).unbind(), strict=True))


class _Lazily(Mapping[str, Tensor]):
    """The body state of some worlds; bodies' places are computed only on demand."""

    def __init__(self, physics: BatchedPhysics, rows: Indices) -> None:
        self._physics, self._rows = physics, rows
        self._whole: dict[str, Array] | None = None

    def __getitem__(self, key: str) -> Tensor:
        if key in ("qpos", "qvel"):  # indexing by a slice would give a view of what the next step changes
            return torch.from_numpy(np.array(getattr(self._physics, key)[self._rows]))
        if self._whole is None:
            self._whole = {name: value[self._rows] for name, value in self._physics.body_state().items()}
        return torch.from_numpy(self._whole[key])

    def __iter__(self) -> Iterator[str]:
        return iter(BODY_KEYS)

    def __len__(self) -> int:
        return len(BODY_KEYS)


class EgoPoseEnv(EnvBase):
    """N worlds in step, batch ``[N]``.

    Time: a reset puts a world on reference frame s. A step applies the action (the PD target for frame s + 1), runs the
    physics to s + 1 and rewards the state there against the reference there.

    Observations: the problem's, float32 and raw (``humanoid_state [115]`` of imitation), and ``root_on_path [3]`` where
    the problem follows a path, which is laid where a world is placed; int64 ``frame [1]``,
    ``episode_start [1]`` and ``episode_stop [1]`` (global frames, stop exclusive), ``episode_step [1]``. Action:
    ``action [52]``. Reward: ``reward``, and ``reward_terms`` (nested, ``[1]`` each). Flags, bool ``[1]``: the problem's
    endings (``fallen``), ``diverged``, ``terminated`` (an ending that ends the episode, or diverged physics),
    ``truncated`` (horizon or end of the fragment), ``done``.

    A reset may bring its own first state: ``initial_qpos [N, 59]`` and ``initial_qvel [N, 58]`` in the reset's
    TensorDict, read at the worlds being reset.

    Args:
        problem: the task, see :class:`~egopose.envs.problem.Problem`.
        num_envs: N.
        starts: deals episodes.
        threads: of the physics.
        seed: of the starts.
        dump_dir: where diverged worlds leave their last states.

    A collector does not need rewards in order to act: after :meth:`make_rewards_lazy` it asks for those of a batch at
    once.

    The simulation's state is :meth:`state_dict`; note that TorchRL's ``TransformedEnv.state_dict`` holds the
    transforms only: take the base environment's beside it.
    """

    def __init__(
        self,
        problem: Problem,
        num_envs: int,
        starts: Starts,
        *,
        threads: int = 1,
        seed: int = 0,
        dump_dir: str | Path | None = None,
    ) -> None:
        super().__init__(device=None, batch_size=torch.Size([num_envs]))
        humanoid = problem.humanoid
        self.problem, self.starts = problem, starts
        self.physics = BatchedPhysics(
            humanoid.mj_model,
            num_envs,
            humanoid.substeps,
            threads,
            body_ids=humanoid.body_ids,
            dump_dir=dump_dir,
            contacts="contacts" in problem.watched,
            torques="torques" in problem.watched,
        )
        self._generator = torch.Generator().manual_seed(seed)
        # Arrays, as everything that is worked out for the few worlds of a step but what is put in entries: an operator
        # of torch costs several times as much.
        self._take, self._start, self._stop, self._frame = np.zeros((4, num_envs), dtype=np.int64)
        self.placed = torch.zeros(num_envs, humanoid.mj_model.nu, dtype=torch.float64)
        self._targets = torch.zeros(num_envs, humanoid.mj_model.nu, dtype=torch.float64)
        self.laid = torch.zeros(num_envs, 3, dtype=torch.float64)  # see egopose.envs.mdp.path
        self.memory = torch.zeros(num_envs, problem.memory_size, dtype=torch.float64)
        self._unrewarded: list[_Unrewarded] | None = None
        self._earnings: list[Tensor] = []
        self._no_flags = _no_flags(problem.endings, self.batch_size)
        self._unknown_reward = torch.full((num_envs, 1), torch.nan)
        self._make_specs()

    def _make_specs(self) -> None:
        n = self.batch_size[0]
        model = self.problem.humanoid.mj_model
        whole, flag = Unbounded((n, 1), dtype=torch.int64), Binary(1, (n, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            **{k: Unbounded((n, size), dtype=torch.float32) for k, size in self.problem.observation_sizes.items()},
            **({} if self.problem.motion_seen is None else {"root_on_path": Unbounded((n, 3), dtype=torch.float32)}),
            frame=whole.clone(),
            episode_start=whole.clone(),
            episode_stop=whole.clone(),
            episode_step=whole.clone(),
            **self._terms_spec(),
            **{name: flag.clone() for name in (*self.problem.endings, "diverged")},
            shape=(n,),
        )
        self.action_spec = Unbounded((n, model.nu), dtype=torch.float32)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32)
        self.done_spec = Composite(
            {k: flag.clone() for k in _DONE},
            shape=(n,),
        )

    def _terms_spec(self) -> dict[str, Composite]:
        if self._unrewarded is not None:
            return {}
        n = self.batch_size[0]
        return {"reward_terms": Composite({k: Unbounded((n, 1)) for k in self.problem.reward.names}, shape=(n,))}

    def make_rewards_lazy(self) -> None:
        """From now on a step's ``reward`` is NaN and it has no ``reward_terms``: :meth:`rewards_due` gives both.

        What the reward reads of each step is kept until then.
        """
        self._unrewarded = []
        self._make_specs()

    def rewards_due(self) -> dict[str, Tensor]:
        """``reward`` and its terms by name, ``[N, T, 1]`` float32 each, of the T steps since the last call.

        The same values as step by step, but computed for many steps at once: a quarter of the cost.

        Raises:
            RuntimeError: rewards are not deferred, or no step was taken.
        """
        self._reward_waiting()
        if not self._earnings:
            raise RuntimeError("no step waits for its reward")
        earned, self._earnings = torch.cat(self._earnings), []
        earned = earned.unflatten(0, (-1, self.batch_size[0])).permute(2, 1, 0).contiguous()
        return dict(zip(("reward", *self.problem.reward.names), earned.unsqueeze(-1).unbind(), strict=True))

    def _reward_waiting(self) -> None:
        if self._unrewarded:
            steps, self._unrewarded = self._unrewarded, []
            all_steps = _joined(steps)
            view = self.problem.step_view(
                all_steps.state, all_steps.frame, all_steps.step, **_step_parts(all_steps.parts)
            )
            self._earnings.append(self._earned(view, all_steps.diverged))

    def _earned(self, view: StepView, diverged: Tensor) -> Tensor:
        """Reward and terms ``[n, 1 + K]`` float32 of a step; a diverged world earns nothing."""
        reward, terms = self.problem.rewards(view)
        return (torch.stack([reward, *terms.values()], dim=-1) * ~diverged[:, None]).float()

    @property
    def frame(self) -> Tensor:
        """``[N]`` global frame each world is at."""
        return torch.from_numpy(self._frame.copy())

    def body_state(self) -> TensorDict:
        """The present body state of all worlds, float64, batch ``[N]``."""
        return TensorDict(
            {k: torch.from_numpy(v) for k, v in self.physics.body_state().items()}, batch_size=self.batch_size
        )

    def _set_seed(self, seed: int | None) -> None:
        self._generator.manual_seed(0 if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            worlds = torch.arange(self.batch_size[0])
        else:
            worlds = mask.reshape(self.batch_size).nonzero().squeeze(-1)
        if len(worlds):
            if tensordict is not None and "initial_qpos" in tensordict:
                self._begin(worlds, tensordict["initial_qpos"][worlds], tensordict["initial_qvel"][worlds])
            else:
                self._begin(worlds)
        return self.observe()

    def begin(self, worlds: Tensor) -> dict[str, Any]:
        """Begin an episode in each of ``worlds [n]``; the entries of their first observations."""
        self._begin(worlds)
        return self._observed(worlds)

    def _begin(self, worlds: Tensor, *state: Tensor) -> None:
        episodes = self.starts(worlds, self._generator)
        # New counters, not new values in the old ones: those are in the observations given out.
        rows = worlds.numpy()
        self._take = _replaced(self._take, rows, episodes.take.numpy())
        self._start = _replaced(self._start, rows, episodes.start.numpy())
        self._stop = _replaced(self._stop, rows, episodes.stop.numpy())
        self._frame = _replaced(self._frame, rows, episodes.start.numpy())
        self.memory[worlds] = 0.0
        scene = self.problem.boxes(episodes.start, self._generator)
        if scene is not None:
            self.physics.place_boxes(rows, *(part.numpy() for part in scene))
        if state:
            self.place(worlds, *state)
        else:
            self._put(worlds, *self.problem.first_state(episodes.start, scene))

    def place(self, worlds: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put ``worlds [n]`` at ``qpos [n, 59]`` and ``qvel [n, 58]`` without touching their time or episode.

        Raises:
            ValueError: a value that is not finite.
        """
        if not (torch.isfinite(qpos).all() and torch.isfinite(qvel).all()):
            raise ValueError("a world cannot be placed at a state that is not finite")
        self._put(worlds, qpos, qvel)

    def _put(self, worlds: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        self.physics.set_state(worlds.numpy(), qpos.double().numpy(), qvel.double().numpy())
        if self.problem.remembers_start:
            self.placed[worlds] = qpos[:, 7:].double()
        if (motion := self.problem.motion_seen) is not None:
            self.laid[worlds] = lay(present_path(motion, self._clock(worlds.numpy())), root_on_floor(qpos.double()))

    def observe(self, worlds: Tensor | slice = ALL) -> TensorDict:
        """The present observation of ``worlds [n]`` (default all), as a reset would return it (after :meth:`place`)."""
        entries = self._observed(worlds)
        return TensorDict(entries, batch_size=entries["done"].shape[:1])

    def _observed(self, worlds: Tensor | slice) -> dict[str, Any]:
        rows = worlds if isinstance(worlds, slice) else worlds.numpy()
        clock = self._clock(rows)
        frame = clock["frame"].squeeze(-1)
        return {
            **clock,
            **self._observations(_Lazily(self.physics, rows), frame, rows),
            **self._terms(torch.zeros(len(frame), len(self.problem.reward.names))),
            **_no_flags(self.problem.endings, frame.shape),
        }

    def _observations(
        self, state: BodyState | BodyView, frame: Tensor, worlds: NDArray[np.integer] | slice = ALL
    ) -> dict[str, Tensor]:
        seen = {key: value.float() for key, value in self.problem.observations(state, frame).items()}
        if self.problem.motion_seen is not None:
            qpos = state.qpos if isinstance(state, BodyView) else state["qpos"]
            seen["root_on_path"] = on_path(self.laid[worlds], root_on_floor(qpos)).float()
        return seen

    def ongoing(self, after: Mapping[Any, Any], worlds: slice = ALL) -> dict[str, Tensor]:
        """Counters and flags of ``worlds`` in the entries ``after`` a step; those that are done begin a new episode."""
        flags = {name: flag[worlds] for name, flag in self._no_flags.items()}
        going_on = {name: after[name] & ~after["done"] for name in self.problem.endings}
        return {**self._clock(worlds), **flags, **going_on}

    def _terms(self, columns: Tensor) -> dict[str, TensorDict]:
        """``reward_terms`` of ``[n, K]``, unless they are deferred."""
        if self._unrewarded is not None:
            return {}
        terms = dict(zip(self.problem.reward.names, columns.split(1, dim=-1), strict=True))
        return {"reward_terms": TensorDict(terms, batch_size=columns.shape[:1])}

    def _clock(self, worlds: NDArray[np.integer] | slice = ALL) -> dict[str, Tensor]:
        frame, start, stop = self._frame[worlds, None], self._start[worlds, None], self._stop[worlds, None]
        clock = {"frame": frame, "episode_start": start, "episode_stop": stop, "episode_step": frame - start}
        return {name: torch.from_numpy(counter) for name, counter in clock.items()}

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        stopped = self.physics.step(self._target(tensordict["action"], ALL))
        return TensorDict(self._arrived(stopped, ALL), batch_size=self.batch_size)

    def try_step(self, action: Tensor, worlds: slice = ALL) -> dict[str, Tensor]:
        """A trial step of ``worlds``, a range, under ``action [n, A]``: there is no reward, and no episode ends.

        Returns:
            The entries of the bodies' observations.
        """
        stopped = self.physics.step(self._target(action, worlds), worlds)
        clock, diverged = self._clock(worlds), torch.from_numpy(stopped[:, None])
        flags = {name: flag[worlds] for name, flag in self._no_flags.items()}
        seen = self._observations(_Lazily(self.physics, worlds), clock["frame"].squeeze(-1), worlds)
        return {**clock, **flags, "diverged": diverged, **seen}

    def bodies(self, qpos: Array, qvel: Array) -> BodyView:
        """Bodies ``[n]`` at ``qpos [n, nq]`` and ``qvel [n, nv]``, which are in no world."""
        state = {"qpos": qpos, "qvel": qvel, **self.physics.poses(qpos)}
        return self.problem.view({name: torch.from_numpy(value) for name, value in state.items()})

    def begin_step(self, action: Tensor, worlds: slice) -> None:
        """Have the physics' threads take a step of ``worlds``, a range, under ``action [n, A]``, while the caller works
        for others."""
        self.physics.begin_step(self._target(action, worlds), worlds)

    def end_step(self, worlds: slice) -> dict[str, Any]:
        """Wait for what :meth:`begin_step` began; the entries that a step of these worlds alone would have returned.

        With deferred rewards the ranges must take turns, in their order.
        """
        return self._arrived(self.physics.end_step(worlds), worlds)

    def _target(self, action: Tensor, worlds: slice) -> Array:
        # A world past its fragment's end (evaluation steps on until the last world is done) stays on its last frame.
        frame = np.minimum(self._frame[worlds] + 1, self._stop[worlds] - 1)
        # A new counter, not new values in the old one: that is in the observations given out.
        self._frame = _replaced(self._frame, worlds, frame)
        target = self.problem.target(action.detach(), torch.from_numpy(frame), self.placed[worlds])
        if "target" in self.problem.watched:
            self._targets[worlds] = target
        return target.numpy()

    def _watched(self, body: dict[str, Tensor], worlds: slice) -> dict[str, Tensor]:
        """The watched parts of the present step beside the body; all but the boxes are taken out of ``body``."""
        parts: dict[str, Tensor] = {
            name: body.pop(name) for name in ("floor_contacts", "box_contacts", "torques") if name in body
        }
        if "scene" in self.problem.watched:
            parts["scene"] = _scene(body)
        if "target" in self.problem.watched:
            parts["target"] = self._targets[worlds].clone()
        return parts

    def _arrived(self, stopped: NDArray[np.bool_], worlds: slice) -> dict[str, Any]:
        body = {k: torch.from_numpy(v) for k, v in self.physics.body_state(worlds).items()}
        clock = self._clock(worlds)
        frame, steps = clock["frame"].squeeze(-1), clock["episode_step"].squeeze(-1)
        parts = self._watched(body, worlds)
        view = self.problem.step_view(body, frame, steps, **_step_parts(parts))
        if self.problem.memory_size:
            self.memory[worlds] = self.problem.remembered(view, self.memory[worlds])
            view = replace(view, memory=self.memory[worlds].clone())
        endings = self.problem.ended(view, torch.from_numpy(self._take[worlds]))
        terminated = stopped
        for name in self.problem.ends_episode:
            terminated = terminated | endings[name].numpy()
        truncated = (self._frame[worlds] >= self._stop[worlds] - 1) & ~terminated
        done = terminated | truncated
        if done.any():
            rows = torch.from_numpy(done)
            start = torch.from_numpy(self._start[worlds])
            self.starts.ended(start[rows], steps[rows], torch.from_numpy(terminated)[rows])
        diverged = torch.from_numpy(stopped)
        if self._unrewarded is None:
            earned = self._earned(view, diverged)
            reward, terms = earned[:, :1], self._terms(earned[:, 1:])
        else:
            self._unrewarded.append(_Unrewarded(body, parts, frame, steps, diverged))
            # Some at a time: what is worked out between fits the core's cache, and the physics goes on meanwhile.
            if len(self._unrewarded) * len(stopped) >= _STEPS_REWARDED_AT_ONCE * self.batch_size[0]:
                self._reward_waiting()
            reward, terms = self._unknown_reward[worlds], {}
        flags = {"diverged": stopped, "terminated": terminated, "truncated": truncated, "done": done}
        return {
            **clock,
            **self._observations(view.body, frame, worlds),
            "reward": reward,
            **terms,
            **{name: flag[:, None] for name, flag in endings.items()},
            **{name: torch.from_numpy(flag[:, None]) for name, flag in flags.items()},
        }

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Tensor]:
        """The state with which the simulation goes on to the bit: physics, episodes, random numbers, counters."""
        physics = {f"physics.{k}": torch.from_numpy(v) for k, v in self.physics.state_dict().items()}
        return physics | {
            "generator": self._generator.get_state(),
            "take": torch.from_numpy(self._take.copy()),
            "start": torch.from_numpy(self._start.copy()),
            "stop": torch.from_numpy(self._stop.copy()),
            "frame": torch.from_numpy(self._frame.copy()),
            **({"placed": self.placed.clone()} if self.problem.remembers_start else {}),
            **({} if self.problem.motion_seen is None else {"laid": self.laid.clone()}),
            **({"memory": self.memory.clone()} if self.problem.memory_size else {}),
            **self.starts.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Tensor], *args: Any, **kwargs: Any) -> None:
        """Go on from :meth:`state_dict`: no reset, :meth:`observe` gives the observation to act on.

        Raises:
            ValueError: another number of worlds or another model.
        """
        physics = {k.removeprefix("physics."): v.numpy() for k, v in state_dict.items() if k.startswith("physics.")}
        self.physics.load_state_dict(physics)
        self._generator.set_state(state_dict["generator"])
        self._take, self._start, self._stop, self._frame = (
            state_dict[k].numpy().copy() for k in ("take", "start", "stop", "frame")
        )
        if self.problem.remembers_start:
            self.placed = state_dict["placed"].clone()
        if self.problem.motion_seen is not None:
            self.laid = state_dict["laid"].clone()
        if self.problem.memory_size:
            self.memory = state_dict["memory"].clone()
        self.starts.load_state_dict(state_dict)

    def close(self, *, raise_if_closed: bool = True) -> None:
        self.physics.close()
        super().close(raise_if_closed=raise_if_closed)
