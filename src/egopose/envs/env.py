"""The batched environment: N humanoids imitating N pieces of reference motion, as one TorchRL ``EnvBase``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from egopose.envs.problem import ImitationProblem
from egopose.envs.starts import Starts
from egopose.humanoid.physics import BatchedPhysics


class EgoPoseEnv(EnvBase):
    """N worlds in step, batch ``[N]``.

    Time: a reset puts a world on reference frame s. A step applies the action (the PD target for frame s + 1), runs the
    physics to s + 1 and rewards the state there against the reference there.

    Keys: ``humanoid_state [115]`` float32 (raw); int64 ``frame [1]`` (global reference frame), ``episode_start [1]``
    (global), ``episode_stop [1]`` (global, exclusive), ``episode_step [1]``; ``reward_terms`` (nested, ``[1]`` each);
    ``fallen [1]`` and ``diverged [1]`` bool; ``action [52]``; ``reward``; ``terminated`` (fall, diverged physics),
    ``truncated`` (horizon or end of the fragment), ``done``.

    A reset may bring its own first state: ``initial_qpos [N, 59]`` and ``initial_qvel [N, 58]`` in the reset's
    TensorDict, read at the worlds being reset.

    Args:
        problem: humanoid, reference, reward, action and termination.
        n_worlds: N.
        starts: deals episodes.
        threads: of the physics.
        seed: of the starts.
        dump_dir: where diverged worlds leave their last states.

    The simulation's state is :meth:`state_dict`; note that TorchRL's ``TransformedEnv.state_dict`` holds the
    transforms only: take the base environment's beside it.
    """

    def __init__(
        self,
        problem: ImitationProblem,
        n_worlds: int,
        starts: Starts,
        *,
        threads: int = 1,
        seed: int = 0,
        dump_dir: str | Path | None = None,
    ) -> None:
        super().__init__(device=None, batch_size=torch.Size([n_worlds]))
        humanoid = problem.humanoid
        self.problem, self.starts = problem, starts
        self.physics = BatchedPhysics(
            humanoid.mj_model,
            n_worlds,
            humanoid.substeps,
            threads,
            body_ids=humanoid.body_ids,
            dump_dir=dump_dir,
        )
        self._generator = torch.Generator().manual_seed(seed)
        counter = torch.zeros(n_worlds, dtype=torch.int64)
        self._take, self._start, self._stop, self._frame = (counter.clone() for _ in range(4))
        self.placed = torch.zeros(n_worlds, humanoid.mj_model.nu, dtype=torch.float64)
        self._make_specs(n_worlds)

    def _make_specs(self, n: int) -> None:
        model = self.problem.humanoid.mj_model
        whole, flag = Unbounded((n, 1), dtype=torch.int64), Binary(1, (n, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            humanoid_state=Unbounded((n, 2 * model.nq - 3), dtype=torch.float32),
            frame=whole.clone(),
            episode_start=whole.clone(),
            episode_stop=whole.clone(),
            episode_step=whole.clone(),
            reward_terms=Composite({k: Unbounded((n, 1)) for k in self.problem.reward.names}, shape=(n,)),
            fallen=flag.clone(),
            diverged=flag.clone(),
            shape=(n,),
        )
        self.action_spec = Unbounded((n, model.nu), dtype=torch.float32)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32)
        self.done_spec = Composite(
            {k: flag.clone() for k in ("done", "terminated", "truncated")},
            shape=(n,),
        )

    @property
    def frame(self) -> Tensor:
        """``[N]`` global frame each world is at."""
        return self._frame.clone()

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

    def begin(self, worlds: Tensor) -> TensorDict:
        """Begin an episode in each of ``worlds [n]``; their first observations, batch ``[n]``."""
        self._begin(worlds)
        return self.observe(worlds)

    def _begin(self, worlds: Tensor, *state: Tensor) -> None:
        episodes = self.starts(worlds, self._generator)
        self._take[worlds], self._start[worlds], self._stop[worlds] = episodes.take, episodes.start, episodes.stop
        self._frame[worlds] = episodes.start
        self.place(worlds, *(state or self.problem.first_state(episodes.start)))

    def place(self, worlds: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Put ``worlds [n]`` at ``qpos [n, 59]`` and ``qvel [n, 58]`` without touching their time or episode.

        Raises:
            ValueError: a value that is not finite.
        """
        if not (torch.isfinite(qpos).all() and torch.isfinite(qvel).all()):
            raise ValueError("a world cannot be placed at a state that is not finite")
        self.physics.set_state(worlds.numpy(), qpos.double().numpy(), qvel.double().numpy())
        self.placed[worlds] = qpos[:, 7:].double()

    def observe(self, worlds: Tensor | None = None) -> TensorDict:
        """The present observation of ``worlds [n]`` (default all), as a reset would return it (after :meth:`place`)."""
        # The state z needs no kinematics, and concatenating makes a copy of it. All worlds at once even for a few: how
        # matrix products round depends on their shape.
        z = self.problem.observation(
            {"qpos": torch.from_numpy(self.physics.qpos), "qvel": torch.from_numpy(self.physics.qvel)}
        ).float()
        rows = slice(None) if worlds is None else worlds
        z = z[rows]
        size = z.shape[:1]
        terms = torch.zeros(*size, len(self.problem.reward.names)).split(1, dim=-1)
        flags = ("fallen", "diverged", "done", "terminated", "truncated")
        return TensorDict(
            {
                **self._clock(rows),
                "humanoid_state": z,
                "reward_terms": TensorDict(dict(zip(self.problem.reward.names, terms, strict=True)), batch_size=size),
                **{k: torch.zeros(*size, 1, dtype=torch.bool) for k in flags},
            },
            batch_size=size,
        )

    def _clock(self, rows: Tensor | slice = slice(None)) -> dict[str, Tensor]:
        frame, start, stop = self._frame[rows, None], self._start[rows, None], self._stop[rows, None]
        # Copies: a reset writes into the counters.
        return {
            "frame": frame.clone(),
            "episode_start": start.clone(),
            "episode_stop": stop.clone(),
            "episode_step": frame - start,
        }

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        # A world past its fragment's end (evaluation steps on until the last world is done) stays on its last frame.
        self._frame = torch.minimum(self._frame + 1, self._stop - 1)
        target = self.problem.target(tensordict["action"].detach(), self._frame, self.placed)
        diverged = torch.from_numpy(self.physics.step(target.numpy()).copy())
        state = self.problem.view({k: torch.from_numpy(v) for k, v in self.physics.body_state().items()})
        reward, terms = self.problem.rewards(state, self._frame, self._frame - self._start)
        fallen = self.problem.fallen(state, self._take)
        terminated = diverged | fallen if self.problem.termination.enabled else diverged
        truncated = (self._frame >= self._stop - 1) & ~terminated
        # One tensor for all: a diverged world earns nothing.
        earned = torch.stack([reward, *terms.values()], dim=-1) * ~diverged[:, None]
        columns = earned.float().split(1, dim=-1)
        return TensorDict(
            {
                **self._clock(),
                "humanoid_state": self.problem.observation(state).float(),
                "reward": columns[0],
                "reward_terms": TensorDict(dict(zip(terms, columns[1:], strict=True)), batch_size=self.batch_size),
                "fallen": fallen[:, None],
                "diverged": diverged[:, None],
                "terminated": terminated[:, None],
                "truncated": truncated[:, None],
                "done": (terminated | truncated)[:, None],
            },
            batch_size=self.batch_size,
        )

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Tensor]:
        """All that the simulation needs to go on to the bit: physics, episodes, random numbers, counters."""
        physics = {f"physics.{k}": torch.from_numpy(v) for k, v in self.physics.state_dict().items()}
        return physics | {
            "generator": self._generator.get_state(),
            "take": self._take.clone(),
            "start": self._start.clone(),
            "stop": self._stop.clone(),
            "frame": self._frame.clone(),
            **({"placed": self.placed.clone()} if self.problem.action.reference == "start" else {}),
        }

    def load_state_dict(self, state_dict: dict[str, Tensor], *args: Any, **kwargs: Any) -> None:
        """Go on from :meth:`state_dict`: no reset, :meth:`observe` gives the observation to act on.

        Raises:
            ValueError: another number of worlds or another model.
        """
        self.physics.load_state_dict({k: state_dict[f"physics.{k}"].numpy() for k in ("state", "counters")})
        self._generator.set_state(state_dict["generator"])
        self._take, self._start, self._stop, self._frame = (
            state_dict[k].clone() for k in ("take", "start", "stop", "frame")
        )
        if self.problem.action.reference == "start":
            self.placed = state_dict["placed"].clone()

    def close(self, *, raise_if_closed: bool = True) -> None:
        self.physics.close()
        super().close(raise_if_closed=raise_if_closed)
