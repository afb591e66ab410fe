"""From a configuration and a dataset to the environment with its transforms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl.envs import TransformedEnv

from egopose.collection.stepping import TransformedEgoPoseEnv
from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.envs.env import EgoPoseEnv
from egopose.envs.forecasting_transforms import RecurrentStates
from egopose.envs.transforms import RawState
from egopose.models.recurrent import hidden_keys
from egopose.tasks.dataset import Dataset
from egopose.tasks.task import task_of


def build_env(
    config: Mapping[str, Any],
    dataset: Dataset,
    split: str = "train",
    *,
    num_envs: int,
    threads: int = 1,
    seed: int = 0,
    whole_fragments: bool = False,
    falls_end: bool | None = None,
    dump_dir: Path | None = None,
    fragments: Sequence[FragmentLike] | None = None,
) -> TransformedEnv:
    """The environment with its transforms: the task's, and what algorithm and networks need beside them.

    Args:
        config: resolved.
        dataset: see :class:`Dataset`.
        split: ``train`` or ``test`` fragments.
        num_envs: N.
        threads: of the physics.
        seed: of the starts.
        whole_fragments: each world runs its own fragment from end to end.
        falls_end: whether the task's endings end an episode; None for what the configuration says.
        dump_dir: where diverged worlds leave their last states.
        fragments: in place of those of ``split``.

    Raises:
        InputError: the configuration does not fit the task, asks for a table the dataset lacks, or the rooms refuse it.
    """
    task = task_of(config)
    task.check(config)
    dataset = task.followed(config, dataset)
    pieces = fragments or (dataset.train if split == "train" else dataset.test)
    try:
        problem = task.problem(config, dataset, falls_end)
        starts = task.starts(config, problem, pieces, whole_fragments)
        base = EgoPoseEnv(problem, num_envs, starts, threads=threads, seed=seed, dump_dir=dump_dir)
    except (ValueError, TypeError) as error:
        raise error if isinstance(error, InputError) else InputError("configuration", "task", str(error)) from None
    transforms = task.transforms(config, dataset, problem)
    if "discriminator" in config.get("algo", ()):  # it compares states in their own units
        transforms.insert(0, RawState())
    if (memory := config["model"].get("memory")) is not None:
        keys = [key for owner in ("policy", "value") for key in hidden_keys(owner)]
        transforms.append(RecurrentStates(dict.fromkeys(keys, int(memory["hidden_size"]))))
    return TransformedEgoPoseEnv(base, *transforms)
