"""The task: one value holds everything that differs between tasks, so no other code tests a task's name.

A task is a file of this room that ends in ``TASK = ...``, and a file of ``conf/task`` whose ``name`` is the file's. A
task outside of the package is a module that the environment variable ``EGOPOSE_TASKS`` names (several with commas
between), or an entry point of the group ``egopose.tasks``. A configuration alone cannot make the program import
anything.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from torchrl.envs.transforms import Transform

from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.envs.problem import Problem
from egopose.envs.starts import Starts
from egopose.tasks.dataset import Dataset

#: The environment variable that names modules with tasks, separated by commas.
VARIABLE = "EGOPOSE_TASKS"
GROUP = "egopose.tasks"


class Sources(Protocol):
    """The data from which a task can make its dataset; the pipeline provides it."""

    def motions(self) -> Dataset:
        """Humanoid, reference and fragments: no video is rendered or looked at."""
        ...

    def other_motions(self, name: str, folder: str, subjects: Sequence[str] | None) -> Dataset:
        """:meth:`motions` of another choice of ``conf/data`` in ``folder``, all takes of ``subjects`` for training."""
        ...

    def seen_motions(self) -> Dataset:
        """:meth:`motions` with what the state regressor sees in the wearer's videos."""
        ...


class Task(Protocol):
    """One task. Every method takes the resolved configuration.

    Attributes:
        name: of its file and of ``conf/task``.
        protocol: how a policy of it is scored, a key of :data:`egopose.evaluation.run.PROTOCOLS`.
    """

    name: str
    protocol: str

    def context(self, config: Mapping[str, Any]) -> int | None:
        """Frames that are seen before an episode begins; None if an episode begins with its first seen frame."""
        ...

    def check(self, config: Mapping[str, Any]) -> None:
        """Raises InputError: the configuration does not fit the task; names the field."""
        ...

    def dataset(self, config: Mapping[str, Any], sources: Sources) -> Dataset:
        """What the task is trained on and judged by."""
        ...

    def followed(self, config: Mapping[str, Any], dataset: Dataset) -> Dataset:
        """The dataset as policy and body see it."""
        ...

    def problem(self, config: Mapping[str, Any], dataset: Dataset, endings_end: bool | None) -> Problem:
        """The problem on :meth:`followed` data.

        Args:
            config: resolved.
            dataset: see :meth:`followed`.
            endings_end: whether an ending (a fall) ends an episode; None for what the configuration says.
        """
        ...

    def transforms(self, config: Mapping[str, Any], dataset: Dataset, problem: Problem) -> list[Transform]:
        """Transforms of the observation, in their order; ``dataset`` is that of :meth:`followed`."""
        ...

    def starts(
        self, config: Mapping[str, Any], problem: Problem, fragments: Sequence[FragmentLike], whole_fragments: bool
    ) -> Starts:
        """Where episodes begin; with ``whole_fragments`` each world runs its own fragment from end to end."""
        ...


def task_name(config: Mapping[str, Any]) -> str:
    """The name of a configuration's task."""
    return str(config["task"]["name"])


def task_of(config: Mapping[str, Any]) -> Task:
    """The task of a configuration.

    Raises:
        InputError: there is none of that name; names those there are.
    """
    name = task_name(config)
    tasks = {
        module.name: f"{__package__}.{module.name}" for module in pkgutil.iter_modules([str(Path(__file__).parent)])
    }
    if name in tasks and (found := getattr(importlib.import_module(tasks[name]), "TASK", None)) is not None:
        return found
    others = _others()
    if name in others:
        return others[name]
    known = [n for n, module in tasks.items() if hasattr(importlib.import_module(module), "TASK")]
    there = ", ".join(sorted([*known, *others]))
    raise InputError(
        "configuration", "task.name", f"there is no task {name!r}; there are {there} (your own: {VARIABLE})"
    )


def _others() -> dict[str, Task]:
    """Tasks outside of the package, by name."""
    modules = [word.strip() for word in os.environ.get(VARIABLE, "").split(",") if word.strip()]
    found: dict[str, Task] = {}
    for module in modules:
        try:
            task = importlib.import_module(module).TASK
        except (ImportError, AttributeError) as error:
            raise InputError(VARIABLE, module, f"gives no task: {error}") from None
        found[task.name] = task
    for point in entry_points(group=GROUP):
        task = point.load()
        found.setdefault(task.name, task)
    return found
