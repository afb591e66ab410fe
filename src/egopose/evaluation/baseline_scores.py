"""From a configuration to a trained method of another paper: ERD, acLSTM, PathPose; what ``egopose.baseline`` runs."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from egopose.data.fragments import FragmentLike
from egopose.evaluation.protocols import ContactSettings, TakeScores, score_take
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.baselines import _rows
from egopose.tasks.dataset import Dataset


def score_motions(
    motions: Sequence[Motion], fragments: Sequence[FragmentLike], dataset: Dataset, contact: ContactSettings
) -> list[TakeScores]:
    """Figures of a kinematic method's motions, one a fragment, against the reference."""
    truth: Array = torch.as_tensor(dataset.reference["qpos"]).double().numpy()
    return [
        score_take(motion.name, motion.qpos, truth[_rows(dataset, fragment)], dataset.humanoid, contact)
        for motion, fragment in zip(motions, fragments, strict=True)
    ]
