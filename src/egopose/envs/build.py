"""From configuration and a reference to the environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from egopose.data.fragments import FragmentLike
from egopose.envs.aids import Aids
from egopose.envs.env import EgoPoseEnv
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.problem import ActionSettings, ImitationProblem, TakeTable, TerminationSettings
from egopose.envs.reference_forecasts import ReferenceForecasts
from egopose.envs.starts import AdaptiveStarts, Starts, UniformStarts, WholeFragments, after_context
from egopose.humanoid.model import HumanoidModel


def build_problem(
    humanoid: HumanoidModel,
    reference: TensorDictBase,
    takes: TakeTable,
    task: Mapping[str, Any],
    reward: Mapping[str, Any],
    *,
    action_reference: Tensor | None = None,
    forecasts: ReferenceForecasts | None = None,
) -> ImitationProblem:
    """The imitation problem of a ``conf/task`` and a ``conf/reward`` file.

    Raises:
        ValueError: see :class:`ImitationProblem` and :func:`build_reward`.
    """
    return ImitationProblem(
        humanoid,
        reference,
        takes,
        build_reward(reward),
        ActionSettings(**task["action"]),
        TerminationSettings(**task["termination"]),
        action_reference,
        forecasts,
    )


def build_env(
    problem: ImitationProblem,
    fragments: Sequence[FragmentLike],
    num_envs: int,
    task: Mapping[str, Any],
    *,
    threads: int = 1,
    seed: int = 0,
    whole_fragments: bool = False,
    dump_dir: str | Path | None = None,
    aids: Aids | None = None,
    workers: int = 1,
) -> EgoPoseEnv:
    """The batched environment.

    Args:
        problem: see :func:`build_problem`.
        fragments: where episodes lie.
        num_envs: N; with ``whole_fragments`` usually their number.
        task: ``conf/task``; with a ``context`` an episode begins at the last frame of that many.
        threads: of the physics.
        seed: of the starts.
        whole_fragments: evaluation: each world runs its own fragment from end to end.
        dump_dir: where diverged worlds leave their last states.
        aids: of training; None for none, as everywhere else.
        workers: environments like this one that a run collects in, for the time that aids are counted in.
    """
    offsets, lengths = problem.takes.offsets, problem.takes.lengths
    starts: Starts
    if task.get("context"):
        fragments = after_context(fragments, task["context"], 2 if whole_fragments else task["minimum"])
    if whole_fragments:
        starts = WholeFragments(fragments, offsets, lengths)
    elif aids is not None and aids.starts is not None:
        starts = AdaptiveStarts(fragments, offsets, lengths, task["horizon"], task["minimum"], aids.starts)
    else:
        starts = UniformStarts(fragments, offsets, lengths, task["horizon"], task["minimum"])
    return EgoPoseEnv(
        problem, num_envs, starts, threads=threads, seed=seed, dump_dir=dump_dir, aids=aids, workers=workers
    )
