"""TorchRL's ``Evaluator`` on a checkpoint, and beside a training: figures that come while collection goes on."""

from __future__ import annotations

import multiprocessing
import warnings
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Evaluator
from torchrl.envs import EnvBase, TransformedEnv

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.collection.collectors import transform_state
from egopose.core.errors import InputError
from egopose.core.runtime import end_with_parent
from egopose.envs.transforms import StateNormalizer
from egopose.evaluation.trial import trial_env, trial_figures
from egopose.pipeline.agent import load_agent
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Material
from egopose.training.loop import Run, interrupts_held

BACKENDS = ("thread", "process")
#: s to wait for an evaluation at a training's end; one takes seconds.
_PATIENCE = 300.0


def checkpoint_evaluator(
    checkpoint: str | Path,
    backend: str = "thread",
    *,
    which: str = "best",
    split: str = "test",
    worlds: int = 32,
    seed: int = 10000,
    threads: int = 1,
    material: Material | None = None,
) -> Evaluator:
    """TorchRL's evaluator of a trained policy, of estimation or forecasting; its figures are those of survival.

    ``evaluator.evaluate()`` gives ``eval/frames`` (survived, mean over ``worlds`` episodes from starts that stay the
    same), ``eval/fell`` and ``eval/reward``; ``trigger_eval`` and ``poll`` the same in the background.

    Args:
        checkpoint: a checkpoint folder or a run directory.
        backend: ``thread`` or ``process``; there the checkpoint is loaded.
        which: of a run directory, the ``best`` or the ``latest`` checkpoint.
        split: ``test`` or ``train`` fragments.
        worlds: episodes.
        seed: of their starts.
        threads: of the physics.
        material: to run on; None for the run's own.

    Raises:
        InputError: there is no such checkpoint or backend.
    """
    _require(backend)
    folder = find_checkpoint(checkpoint, which)
    steps = int(read_json(folder, "config")["task"]["horizon"]) - 1
    env = partial(_checkpoint_env, folder, material, split, worlds, seed, threads)
    return _evaluator(env, partial(_checkpoint_policy, folder, material), backend, worlds, steps)


def _require(backend: str) -> None:
    if backend not in BACKENDS:
        raise InputError("evaluator", "backend", f"must be one of {', '.join(BACKENDS)}, not {backend!r}")


def _evaluator(make_env: Any, make_policy: Any, backend: str, worlds: int, steps: int) -> Evaluator:
    return Evaluator(
        make_env,
        policy_factory=make_policy,
        backend=backend,
        num_trajectories=worlds,
        max_steps=0,  # a trial ends by itself
        frames_per_batch=worlds * steps,
        collector_kwargs={"auto_register_policy_transforms": False, "traj_format": "padded"},
        metrics_fn=trial_figures,
        init_fn=_one_thread if backend == "process" else None,
    )


def _one_thread() -> None:
    """In a process of its own: the cores are for training."""
    end_with_parent()
    torch.set_num_threads(1)


def _checkpoint_env(
    folder: Path, material: Material | None, split: str, worlds: int, seed: int, threads: int
) -> TransformedEnv:
    agent = load_agent(folder, material)
    env = agent.make_env(split, worlds=worlds, threads=threads)
    return trial_env(env, int(agent.config["task"]["horizon"]) - 1, seed)


def _checkpoint_policy(folder: Path, material: Material | None, env: EnvBase | None = None) -> TensorDictModuleBase:
    return load_agent(folder, material).actor


class NormalizedActor(TensorDictModuleBase):
    """An actor with its state normaliser: all that changes while training, as one set of weights.

    Args:
        normalizer: whose statistics are taken.
        actor: of the normalised state.
    """

    def __init__(self, normalizer: StateNormalizer, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(actor.in_keys), list(actor.out_keys)
        self.actor = actor
        self.normalizer = StateNormalizer(len(normalizer.mean), clip=normalizer.clip, frozen=True)
        self.normalizer.load_state_dict(normalizer.state_dict())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The actor's entries, beside the state in its own units."""
        state = self.normalizer.normalize(tensordict["humanoid_state"])
        out = self.actor(tensordict.copy().set("humanoid_state", state))
        return tensordict.update(out.exclude("humanoid_state"))


class BackgroundSurvival:
    """Frames survived by the mean action, found while training goes on; see :func:`egopose.pipeline.run.build_evaluation`.

    TorchRL's evaluator runs in a process of its own, coordinating thread and all: that thread would set the way
    training draws its actions, which is one for a whole process, while training collects.

    Args:
        run: to be watched.
        material: see :class:`Material`.
    """

    def __init__(self, run: Run, material: Material) -> None:
        self._run, training = run, run.config["training"]
        # Of one world, to read the collector's statistics by; made without a draw of training's random numbers.
        with torch.random.fork_rng(devices=[]):
            self._probe = build_env(run.config, material, "test", worlds=1)
        worlds, steps = int(training["evaluation_worlds"]), int(run.config["task"]["horizon"]) - 1
        make_env = partial(_raw_env, run.config, material, worlds, int(training["evaluation_seed"]))
        make_policy = partial(_untrained_policy, run.config, material)
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        arguments = (other, make_env, make_policy, worlds, steps)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        with interrupts_held():  # a terminal's Ctrl-C is for the training alone
            self._process.start()
        other.close()
        self._waiting: deque[tuple[int, dict[str, Any]]] = deque()
        self._gone = False
        self._busy = True  # until it says that it is there: a pipe takes no weights before somebody reads them

    def begin(self, step: int) -> None:
        """Evaluate the run's present weights, to be told as of ``step``."""
        self._probe.load_state_dict(transform_state(self._run.collector))
        policy = NormalizedActor(_normalizer(self._probe), self._run.ppo.actor)
        state = {name: value.detach().cpu().numpy().copy() for name, value in policy.state_dict().items()}
        self._waiting.append((step, state))
        self._begin_next()

    def _begin_next(self) -> None:
        if self._waiting and not self._busy and not self._gone:
            try:
                self._pipe.send(self._waiting.popleft())
                self._busy = True
            except OSError:
                self._give_up("has lost its process")

    def finished(self, wait: bool = False) -> list[tuple[int, dict[str, float]]]:
        """Steps and figures of what has come to its end; with ``wait``, of all that was begun.

        What does not come within minutes, or because its process is gone, is given up, with a warning.
        """
        found = []
        while not self._gone and (self._waiting or self._busy):
            try:
                if not self._pipe.poll(_PATIENCE if wait else 0.0):
                    if wait:
                        self._give_up("takes too long")
                    break
                told = self._pipe.recv()
            except (EOFError, OSError):
                self._give_up("has lost its process")
                break
            self._busy = False
            self._begin_next()
            found += [told] if told is not None else []
        return found

    def _give_up(self, cause: str) -> None:
        warnings.warn(f"the evaluation beside the training {cause}; there will be no more of them", stacklevel=3)
        self._gone = True

    def close(self) -> None:
        """End its process."""
        self._pipe.close()
        self._process.terminate()
        self._process.join()


def _serve(pipe: Connection, make_env: Any, make_policy: Any, worlds: int, steps: int) -> None:
    """Answer weights with figures until the other end of ``pipe`` is closed."""
    _one_thread()
    policy = make_policy()
    evaluator = _evaluator(make_env, make_policy, "thread", worlds, steps)
    pipe.send(None)
    with suppress(EOFError, OSError):
        while True:
            step, state = pipe.recv()
            policy.load_state_dict({name: torch.from_numpy(value) for name, value in state.items()})
            result = evaluator.evaluate(policy, step=step)
            pipe.send((step, {"score": float(result["eval/frames"]), "falls": float(result["eval/fell"])}))
    evaluator.shutdown()


def _normalizer(env: TransformedEnv) -> StateNormalizer:
    (found,) = (module for module in env.transform.modules() if isinstance(module, StateNormalizer))
    return found


def _raw_env(config: Mapping[str, Any], material: Material, worlds: int, seed: int) -> TransformedEnv:
    """For a :class:`NormalizedActor`: the state in its own units."""
    env = build_env(config, material, "test", worlds=worlds)
    normalizer = _normalizer(env).freeze()
    normalizer.clip = float("inf")
    return trial_env(env, int(config["task"]["horizon"]) - 1, seed)


def _untrained_policy(config: Mapping[str, Any], material: Material, env: EnvBase | None = None) -> NormalizedActor:
    with torch.random.fork_rng(devices=[]):
        own = build_env(config, material, "test", worlds=1)
        actor, _ = build_networks(config, material, own)
        own.close()
    return NormalizedActor(_normalizer(own), actor)
