"""What a policy is trained on and judged by: everything that comes from data, none of it learned by PPO."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from scipy.ndimage import gaussian_filter1d
from tensordict import TensorDictBase
from torch import Tensor

from egopose.data.preparation import fingerprint_of, flow_name, humanoid_of, prepare
from egopose.data.splits import split_takes
from egopose.data.store import TakeInfo, TakeStore
from egopose.envs.futures import Futures
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.problem import TakeTable
from egopose.envs.starts import FragmentLike
from egopose.errors import InputError
from egopose.files import write_text_whole
from egopose.humanoid.model import HumanoidModel
from egopose.regression import kept_tables, regressor_tables
from egopose.untrusted import read_json

PROVENANCE = "provenance.json"
#: Frames, a third of a second: the look-ahead of the causal form (conf/regressor).
_LOOKAHEAD = 10


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
        store_fingerprint: of the store it all comes from, or None.
        futures: kinematic forecasts a policy follows, or None.
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
    store_fingerprint: str | None = None
    futures: Futures | None = None

    def keep_regressor(self, folder: Path) -> None:
        """Copy the state regressor's weights to ``folder/regressor``, so that a run can be used without its store."""
        if self.regressor is not None and not (folder / "regressor").exists():
            part = folder / "regressor.part"
            shutil.rmtree(part, ignore_errors=True)
            shutil.copytree(self.regressor, part)
            os.replace(part, folder / "regressor")

    def keep_provenance(self, folder: Path) -> None:
        """Note in ``folder/provenance.json`` which store a run is trained on.

        Raises:
            InputError: the run was begun on another store.
        """
        if self.store_fingerprint is None:
            return
        if (folder / PROVENANCE).is_file():
            require_same_store(folder, self.store_fingerprint)
            return
        folder.mkdir(parents=True, exist_ok=True)
        write_text_whole(folder / PROVENANCE, json.dumps({"store_fingerprint": self.store_fingerprint}, indent=1))


def require_same_store(run: Path, fingerprint: str) -> None:
    """A run may go on, or be judged, only on the data it was trained on. Runs that noted no store are let through.

    Raises:
        InputError: the run directory notes another fingerprint, or its note is damaged.
    """
    path = run / PROVENANCE
    if not path.is_file():
        return
    try:
        noted = read_json(path, "store_fingerprint")["store_fingerprint"]
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(path, "store_fingerprint", f"is damaged: {error!r}") from None
    if noted != fingerprint:
        raise InputError(
            path,
            "store_fingerprint",
            f"the run was trained on a store {str(noted)[:10]}, its configuration now gives {fingerprint[:10]}: "
            "the source files or the version of the preparation have changed since",
        )


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
    return _with_tables(config, store, *regressor_tables(config, store, humanoid_of(config), flow_name(config)))


def run_material(config: Mapping[str, Any], run: Path, same_store: bool = True, progress: bool = True) -> Material:
    """The material of a trained run, seen by the run's own state regressor ``run/regressor``; nothing is trained.

    Args:
        config: the run's, resolved. Its data is prepared where that has not been done yet.
        run: the run directory.
        same_store: whether the data must be what the run was trained on; False for data of another set.
        progress: show bars.

    Raises:
        InputError: as :func:`load_material`; the data is not the run's, or neither run nor store holds a regressor.
    """
    if same_store:
        # Before anything is prepared: hours could pass, only to be refused.
        require_same_store(run, fingerprint_of(config))
    store = prepare(config, progress=progress)
    tables = kept_tables(config, store, humanoid_of(config), flow_name(config), run / "regressor")
    return _with_tables(config, store, *tables)


def _with_tables(config: Mapping[str, Any], store: TakeStore, tables: TensorDictBase, weights: Path) -> Material:
    return replace(
        _motion_of(config, store),
        visual_features=tables["visual_features"],
        visual_context=tables["visual_context"],
        joint_targets=tables["joint_targets"],
        states=tables["humanoid_state"],
        regressor=weights,
        store_fingerprint=store.fingerprint,
    )


def smoothed(material: Material, deviation: float) -> Material:
    """The material with what the regressor saw smoothed in time, take by take.

    The regressor judges each frame nearly by itself: its joints jitter at 14 rad/s^2 where people's move at 3. States
    are smoothed number by number (a quaternion so near its neighbours may be), joint targets and context likewise.

    Args:
        material: with tables of a regressor.
        deviation: s, of a Gaussian cut at a third of a second, which is what the causal form may look ahead; 0 for
            the material as it is.
    """
    if deviation <= 0:
        return material
    frames = deviation / material.humanoid.control_dt
    spans = list(zip(material.takes.offsets.tolist(), material.takes.lengths.tolist(), strict=True))

    def smooth(table: Tensor | None) -> Tensor | None:
        if table is None:
            return None
        out = table.clone()
        for offset, length in spans:
            rows = table[offset : offset + length].double().numpy()
            kept = gaussian_filter1d(rows, frames, axis=0, mode="nearest", radius=_LOOKAHEAD)
            out[offset : offset + length] = torch.from_numpy(kept).to(table.dtype)
        return out

    return replace(
        material,
        states=smooth(material.states),
        joint_targets=smooth(material.joint_targets),
        visual_context=smooth(material.visual_context),
    )


def motion_material(config: Mapping[str, Any], context_size: int = 128) -> Material:
    """For measuring speed without any video: noise for context, the reference's own states and joint angles.

    Raises:
        InputError: as :func:`load_material`.
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
