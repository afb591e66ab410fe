"""A new run of a reconstruction begins with a policy that does as a simulated motion does."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.envs.reconstruction import ReconstructionProblem
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.derivatives import Simulator
from egopose.humanoid.trajectory import TrackingCost
from egopose.models.policy import GaussianHead
from egopose.motion.rotations import Array
from egopose.tasks.dataset import Dataset
from egopose.tasks.reconstruction import ClipDataset
from egopose.training.loop import Run
from egopose.training.plan_cloning import PlanCloningSettings, PlanSchool, clone_plan, set_statistics
from egopose.training.plan_feedback import FeedbackSettings, PlanTeacher

_JUDGED = 32  # bodies
_SIMULATED = 256  # worlds of the teacher's simulator


def teach_plan(run: Run, dataset: Dataset, settings: Mapping[str, Any]) -> None:
    """Teach the policy of ``run``, which has not begun, the simulated motion of its dataset; nothing where it has none.

    Args:
        run: collects in this process.
        dataset: of a clip.
        settings: ``task.cloning``.

    Raises:
        InputError: a setting is missing or wrong, or environments are in other processes.
    """
    if not isinstance(dataset, ClipDataset) or dataset.plan is None:
        return
    if run.collector_settings.kind != "sync":
        raise InputError("conf/collector", "kind", "task.start_from teaches the policy in one process: collector=sync")
    values = dict(settings)
    feedback = dict(values.pop("feedback"))
    feedback["cost"] = from_mapping(TrackingCost, feedback["cost"], "task.cloning.feedback.cost")
    teaching = from_mapping(FeedbackSettings, feedback, "task.cloning.feedback")
    cloning = from_mapping(PlanCloningSettings, values, "task.cloning")
    problem = run.collector.env.base_env.problem
    assert isinstance(problem, ReconstructionProblem)
    seed, threads = int(run.config["seed"]), run.collector_settings
    simulator = Simulator(dataset.humanoid, _SIMULATED, threads.physics_threads)
    try:
        with torch_threads(threads.update_threads):
            _teach(run, problem, PlanTeacher(simulator, dataset.humanoid, dataset.plan, teaching), cloning, seed)
    finally:
        simulator.close()
    run.collector.update_policy_weights_()


def _teach(
    run: Run, problem: ReconstructionProblem, teacher: PlanTeacher, cloning: PlanCloningSettings, seed: int
) -> None:
    head = next(module for module in run.ppo.actor.modules() if isinstance(module, GaussianHead))
    transforms = run.collector.env.transform.modules()
    normalizer = next(module for module in transforms if isinstance(module, StateNormalizer))
    school = PlanSchool(problem, teacher)

    def mean(state: Tensor, scene: Tensor) -> Tensor:
        out: Tensor = head(state, scene)[0]
        return out

    @torch.no_grad()
    def act(frame: NDArray[np.int64], qpos: Array, qvel: Array) -> Array:
        state, scene = school.seen(frame, qpos, qvel)
        return school.target(mean(normalizer.normalize(state), scene), frame)

    lessons, student = None, None
    generator = torch.Generator().manual_seed(seed)
    for number in range(cloning.rounds):
        rng = np.random.default_rng([seed, number])
        met = teacher.replays(cloning.bodies, rng, student)
        more = school.lessons(*met, cloning, rng)
        if lessons is None:
            lessons = more
            set_statistics(normalizer, lessons.state, cloning.counted)
        else:
            lessons = lessons + more
        error = clone_plan(mean, run.ppo.policy_parameters, normalizer, lessons, cloning, generator)
        student = act
        kept = teacher.kept(_JUDGED, np.random.default_rng([seed, cloning.rounds]), act)
        told = f"taught by the plan, round {number}: {len(lessons.state)} lessons, error {error:.3f} units"
        print(
            f"{told}; frames from the first until lost: {kept:.1f} of {len(teacher.plan)}", file=sys.stderr, flush=True
        )
