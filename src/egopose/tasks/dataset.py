"""The data a policy is trained and judged on; nothing in it is learned by PPO."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from scipy.ndimage import gaussian_filter1d
from tensordict import TensorDictBase
from torch import Tensor

from egopose.core.atomic_write import write_text_whole
from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.data.fragments import FragmentLike
from egopose.data.store import TakeInfo
from egopose.envs.problem import TakeTable
from egopose.envs.reference_forecasts import ReferenceForecasts
from egopose.humanoid.model import HumanoidModel

PROVENANCE = "provenance.json"
#: Frames, a third of a second: the look-ahead of the causal form (conf/regressor).
_LOOKAHEAD = 10


@dataclass(frozen=True)
class Dataset:
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
        path: ``[F, 3]`` x, y (m) and heading (rad) of the root that bodies follow with the states; None for what the
            states' own velocities give. Each take may have a world of its own.
        regressor: folder of the state regressor's weights, or None.
        store_fingerprint: of the store it all comes from, or None.
        forecasts: kinematic forecasts a policy follows, or None.
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
    path: Tensor | None = None
    regressor: Path | None = None
    store_fingerprint: str | None = None
    forecasts: ReferenceForecasts | None = None

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
    """A run may be resumed or judged only on the data it was trained on. Runs that noted no store are accepted.

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
        tuple(take.group for take in takes),
    )


def smoothed(dataset: Dataset, deviation: float) -> Dataset:
    """The dataset with the regressor's tables smoothed in time, take by take.

    The regressor treats each frame nearly by itself: its joints jitter at 14 rad/s^2, while people's move at 3. States
    are smoothed number by number (a quaternion so near its neighbours may be), joint targets and context likewise.

    Args:
        dataset: with tables of a regressor.
        deviation: s, of a Gaussian cut at a third of a second, which is what the causal form may look ahead; 0 for
            the dataset as it is.
    """
    if deviation <= 0:
        return dataset
    frames = deviation / dataset.humanoid.control_dt
    spans = list(zip(dataset.takes.offsets.tolist(), dataset.takes.lengths.tolist(), strict=True))

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
        dataset,
        states=smooth(dataset.states),
        joint_targets=smooth(dataset.joint_targets),
        visual_context=smooth(dataset.visual_context),
    )
