"""What a policy is trained on and judged by: everything that comes from data, none of it learned by PPO."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from egopose.data.preparation import flow_name, humanoid_of, prepare
from egopose.data.splits import split_takes
from egopose.data.store import TakeInfo, TakeStore
from egopose.envs.problem import TakeTable
from egopose.envs.starts import FragmentLike
from egopose.humanoid.model import HumanoidModel
from egopose.regression import regressor_tables


@dataclass(frozen=True)
class Material:
    """Humanoid, reference, fragments and the state regressor's tables.

    Args:
        humanoid: compiled at the simulation's rate.
        reference: body states ``[F]`` of all takes.
        takes: where they lie among the F frames.
        train, test: fragments, in frames of their takes.
        visual_features: ``[F, D]``, or None where no network reads them.
        visual_context: ``[F, C]`` of the state regressor, or None.
        joint_targets: ``[F, nu]`` rad of the state regressor, or None.
        states: ``[F, S]`` humanoid states of the state regressor, or None.
        regressor: folder of the state regressor's weights, or None.
    """

    humanoid: HumanoidModel
    reference: TensorDictBase
    takes: TakeTable
    train: Sequence[FragmentLike]
    test: Sequence[FragmentLike]
    visual_features: Tensor | None = None
    visual_context: Tensor | None = None
    joint_targets: Tensor | None = None
    states: Tensor | None = None
    regressor: Path | None = None

    def keep_regressor(self, folder: Path) -> None:
        """Copy the state regressor's weights to ``folder/regressor``, so that a run can be used without its store."""
        if self.regressor is not None and not (folder / "regressor").exists():
            shutil.copytree(self.regressor, folder / "regressor")


def take_table(takes: Sequence[TakeInfo]) -> TakeTable:
    """The takes of a store as tensors."""
    return TakeTable(
        torch.tensor([take.offset for take in takes]),
        torch.tensor([take.length for take in takes]),
        torch.tensor([take.lowest_head_height for take in takes], dtype=torch.float64),
    )


def load_material(config: Mapping[str, Any], progress: bool = True) -> Material:
    """The material ``config`` names: data prepared and state regressor trained where that has not been done yet.

    Raises:
        InputError: data cannot be found or used, the split leaves nothing, or a setting is wrong.
    """
    store = prepare(config, progress=progress)
    tables, weights = regressor_tables(config, store, humanoid_of(config), flow_name(config))
    return replace(
        _motion_of(config, store),
        visual_features=tables["visual_features"],
        visual_context=tables["visual_context"],
        joint_targets=tables["joint_targets"],
        states=tables["humanoid_state"],
        regressor=weights,
    )


def motion_material(config: Mapping[str, Any], context_size: int = 128) -> Material:
    """For measuring speed without any video: noise for context, the reference's own joint angles for joint targets.

    Raises:
        InputError: as :func:`load_material`.
    """
    motion = _motion_of(config, prepare(config, progress=False, flow=False))
    noise = torch.randn(len(motion.reference), context_size, generator=torch.Generator().manual_seed(0))
    return replace(
        motion, visual_features=noise, visual_context=noise, joint_targets=motion.reference["qpos"][:, 7:].float()
    )


def _motion_of(config: Mapping[str, Any], store: TakeStore) -> Material:
    split = config["data"]["split"]
    train, test = (split_takes(store.takes, split, part) for part in ("train", "test"))
    return Material(humanoid_of(config), store.reference, take_table(store.takes), train, test)


def absolute_paths(config: dict[str, Any]) -> dict[str, Any]:
    """The configuration with the files of ``data`` named from the root, so that a run can be resumed from anywhere."""
    data = dict(config["data"])
    for key in ("folder", "store"):
        if data.get(key):
            data[key] = _absolute(data[key])
    if data.get("takes"):
        data["takes"] = [
            {key: _absolute(value) if key in ("motion", "video") and value else value for key, value in take.items()}
            for take in data["takes"]
        ]
    return {**config, "data": data}


def _absolute(path: str) -> str:
    return str(Path(path).expanduser().resolve())
