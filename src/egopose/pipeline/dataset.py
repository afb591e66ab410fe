"""From a configuration to the data a policy is trained and judged on; nothing in it is learned by PPO."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from egopose.checkpoint.pretrained import is_pretrained
from egopose.core.config import compose_config
from egopose.data.preparation import fingerprint_of, flow_name, humanoid_of, prepare
from egopose.data.splits import WHOLE, split_takes
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.pipeline.regressor import kept_tables, regressor_tables
from egopose.tasks.dataset import PROVENANCE, Dataset, require_same_store, take_table
from egopose.tasks.task import task_of

_SECOND = 30  # frames: what fragments of other sets have at least


@dataclass(frozen=True)
class PreparedData:
    """The data from which a task can make its dataset: those of a configuration. See
    :class:`egopose.tasks.task.Sources`.

    Args:
        config: resolved. Its data is prepared where that has not been done yet.
        run: the run directory whose state regressor looks at the data, with nothing trained; None for the data's own
            regressor, trained where that has not been done yet.
        progress: show bars.
    """

    config: Mapping[str, Any]
    run: Path | None = None
    progress: bool = True

    def motions(self) -> Dataset:
        """See :class:`~egopose.tasks.task.Sources`."""
        store = prepare(self.config, progress=self.progress, flow=False)
        return replace(_motion_of(self.config, store), store_fingerprint=store.fingerprint)

    def other_motions(self, name: str, folder: str, subjects: Sequence[str] | None) -> Dataset:
        """See :class:`~egopose.tasks.task.Sources`.

        Raises:
            InputError: there is no such choice, or its motions cannot be used.
        """
        data = compose_config("train", [f"data={name}"])["data"]
        config = {**self.config, "data": {**data, "folder": folder}}
        store = prepare(config, progress=self.progress, flow=False)
        train = split_takes(store.takes, {**WHOLE, "shortest": _SECOND, "subjects": subjects}, "train")
        return Dataset(humanoid_of(config), store.reference, take_table(store.takes), train, ())

    def seen_motions(self) -> Dataset:
        """See :class:`~egopose.tasks.task.Sources`.

        Raises:
            InputError: neither run nor store holds a regressor.
        """
        config = self.config
        store = prepare(config, progress=self.progress)
        humanoid, flow = humanoid_of(config), flow_name(config)
        if self.run is None:
            return _with_tables(config, store, *regressor_tables(config, store, humanoid, flow))
        return _with_tables(config, store, *kept_tables(config, store, humanoid, flow, self.run / "regressor"))


def load_dataset(config: Mapping[str, Any], progress: bool = True) -> Dataset:
    """The dataset of the task that ``config`` names.

    Raises:
        InputError: data cannot be found or used, the split leaves nothing, or a setting is wrong.
    """
    return task_of(config).dataset(config, PreparedData(config, progress=progress))


def run_dataset(config: Mapping[str, Any], run: Path, same_store: bool = True, progress: bool = True) -> Dataset:
    """The dataset of a trained run, with the run's own state regressor ``run/regressor``; nothing is trained.

    Args:
        config: the run's, resolved. Its data is prepared where that has not been done yet. A baseline's names no task:
            its dataset is what the regressor sees.
        run: the run directory.
        same_store: whether the data must be what the run was trained on; False for data of another set.
        progress: show bars.

    Raises:
        InputError: as :func:`load_dataset`; the data is not the run's, or neither run nor store holds a regressor.
    """
    if same_store and (run / PROVENANCE).is_file():
        # Checked before anything is prepared, since preparing can take hours.
        require_same_store(run, fingerprint_of(config))
    prepared = PreparedData(config, run, progress)
    return task_of(config).dataset(config, prepared) if "task" in config else prepared.seen_motions()


def _with_tables(config: Mapping[str, Any], store: TakeStore, tables: TensorDictBase, weights: Path) -> Dataset:
    return replace(
        _motion_of(config, store),
        visual_features=tables["visual_features"],
        visual_context=tables["visual_context"],
        joint_targets=tables["joint_targets"],
        states=tables["humanoid_state"],
        regressor=weights,
        store_fingerprint=store.fingerprint,
    )


def motion_dataset(config: Mapping[str, Any], context_size: int = 128) -> Dataset:
    """For measuring speed without any video: noise for context, the reference's own states and joint angles.

    Raises:
        InputError: as :func:`load_dataset`.
    """
    motion = _motion_of(config, prepare(config, progress=False, flow=False))
    noise = torch.randn(len(motion.reference), context_size, generator=torch.Generator().manual_seed(0))
    return replace(
        motion,
        visual_features=noise,
        visual_context=noise,
        joint_targets=motion.reference["qpos"][:, 7:].float(),
        states=humanoid_state(motion.reference).float(),
    )


def _motion_of(config: Mapping[str, Any], store: TakeStore) -> Dataset:
    split = config["data"]["split"]
    train, test = (split_takes(store.takes, split, part) for part in ("train", "test"))
    return Dataset(humanoid_of(config), store.reference, take_table(store.takes), train, test)


def absolute_paths(config: dict[str, Any]) -> dict[str, Any]:
    """The configuration with its files named from the root, so that a run can be resumed from anywhere."""
    data = dict(config["data"])
    for key in ("folder", "store"):
        if data.get(key):
            data[key] = _absolute(data[key])
    if data.get("takes"):
        data["takes"] = [
            {key: _absolute(value) if key in ("motion", "video") and value else value for key, value in take.items()}
            for take in data["takes"]
        ]
    out = {**config, "data": data}
    if also := config.get("task", {}).get("also"):
        sets = {name: {**row, "folder": row["folder"] and _absolute(row["folder"])} for name, row in also.items()}
        out["task"] = {**config["task"], "also": sets}
    task = out.get("task", {})
    if files := {key: _absolute(task[key]) for key in ("clip", "start_from") if task.get(key)}:
        out["task"] = {**task, **files}
    start = config.get("training", {}).get("start_from")
    if start is not None and not is_pretrained(start):
        out["training"] = {**config["training"], "start_from": _absolute(start)}
    return out


def _absolute(path: str) -> str:
    return str(Path(path).expanduser().resolve())
