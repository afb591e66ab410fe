"""TorchRL's ``Evaluator`` on a checkpoint."""

from __future__ import annotations

import threading
import uuid
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Evaluator
from torchrl.envs import EnvBase, TransformedEnv

from egopose.checkpoint.checkpoint import find_checkpoint, read_json
from egopose.core.errors import InputError
from egopose.core.runtime import end_with_parent
from egopose.evaluation.trial import trial_env, trial_figures
from egopose.pipeline.agent import Agent, load_agent
from egopose.tasks.dataset import Dataset

BACKENDS = ("thread", "process")


def checkpoint_evaluator(
    checkpoint: str | Path,
    backend: str = "thread",
    *,
    which: str = "best",
    split: str = "test",
    num_envs: int = 32,
    seed: int = 10000,
    threads: int = 1,
    dataset: Dataset | None = None,
) -> Evaluator:
    """TorchRL's evaluator of a trained policy, of estimation or forecasting; its figures are those of survival.

    ``evaluator.evaluate()`` gives ``eval/frames`` (survived, mean over ``num_envs`` episodes from starts that stay the
    same), ``eval/fell`` and ``eval/reward``; ``trigger_eval`` and ``poll`` the same in the background.

    Args:
        checkpoint: a checkpoint folder or a run directory.
        backend: ``thread`` or ``process``; there the checkpoint is loaded.
        which: of a run directory, the ``best`` or the ``latest`` checkpoint.
        split: ``test`` or ``train`` fragments.
        num_envs: episodes.
        seed: of their starts.
        threads: of the physics.
        dataset: to run on; None for the run's own.

    Raises:
        InputError: there is no such checkpoint or backend.
    """
    _require(backend)
    folder = find_checkpoint(checkpoint, which)
    steps = int(read_json(folder, "config")["task"]["horizon"]) - 1
    trained = _Trained.of(folder, dataset, uuid.uuid4().hex)
    env = partial(_checkpoint_env, trained, split, num_envs, seed, threads)
    return _evaluator(env, partial(_checkpoint_policy, trained), backend, num_envs, steps)


def _require(backend: str) -> None:
    if backend not in BACKENDS:
        raise InputError("evaluator", "backend", f"must be one of {', '.join(BACKENDS)}, not {backend!r}")


def _evaluator(make_env: Any, make_policy: Any, backend: str, num_envs: int, steps: int) -> Evaluator:
    return Evaluator(
        make_env,
        policy_factory=make_policy,
        backend=backend,
        num_trajectories=num_envs,
        max_steps=0,  # a trial ends by itself
        frames_per_batch=num_envs * steps,
        collector_kwargs={"auto_register_policy_transforms": False, "traj_format": "padded"},
        metrics_fn=trial_figures,
        init_fn=_one_thread if backend == "process" else None,
    )


def _one_thread() -> None:
    """In a process of its own: the cores are for training."""
    end_with_parent()
    torch.set_num_threads(1)


class _Trained:
    """The agent of a checkpoint, loaded once in each process that works with it."""

    #: By token: what makes the environment and what makes the policy are sent to another process one by one.
    _here: ClassVar[WeakValueDictionary[str, _Trained]] = WeakValueDictionary()

    def __init__(self, folder: Path, dataset: Dataset | None, token: str) -> None:
        self._folder, self._dataset, self._token = folder, dataset, token
        self._lock = threading.Lock()
        self._here[token] = self

    @classmethod
    def of(cls, folder: Path, dataset: Dataset | None, token: str) -> _Trained:
        """The one with this token, made where this process has none yet."""
        return cls._here.get(token) or cls(folder, dataset, token)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Trained.of, (self._folder, self._dataset, self._token)

    def agent(self) -> Agent:
        """See :func:`load_agent`."""
        with self._lock:
            return self._agent

    @cached_property
    def _agent(self) -> Agent:
        return load_agent(self._folder, self._dataset)


def _checkpoint_env(trained: _Trained, split: str, num_envs: int, seed: int, threads: int) -> TransformedEnv:
    agent = trained.agent()
    env = agent.make_env(split, num_envs=num_envs, threads=threads)
    return trial_env(env, int(agent.config["task"]["horizon"]) - 1, seed)


def _checkpoint_policy(trained: _Trained, env: EnvBase | None = None) -> TensorDictModuleBase:
    return trained.agent().actor
