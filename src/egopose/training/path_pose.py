"""Clusters, transitions and the egomotion classifier of PathPose from training takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.spans import Span, split_validation
from egopose.humanoid.state_layout import StateLayout
from egopose.models.baselines.path_pose import PathPose, cluster_poses, transition_costs


@dataclass(frozen=True)
class PathPoseSettings:
    """``conf/baseline/path_pose.yaml``, without its ``optimiser``.

    Args:
        clusters: of training poses.
        grid: cells a side of the coarse flow.
        reach, stride: frames before and after that the classifier sees, and every how many of them.
        hidden, dropout: of the classifier.
        smoothing: pseudo-counts of the transitions, see :func:`transition_costs`.
        transition_weights: of the path's energy; the best on held-out frames is kept.
    """

    clusters: int
    grid: int
    reach: int
    stride: int
    hidden: tuple[int, ...]
    dropout: float
    smoothing: float
    transition_weights: tuple[float, ...]

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/baseline") -> PathPoseSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        settings = from_mapping(cls, values, source)
        for name, least in (("clusters", 2), ("grid", 1), ("reach", 0), ("stride", 1)):
            if getattr(settings, name) < least:
                raise InputError(source, name, f"must be at least {least}, not {getattr(settings, name)}")
        if not settings.transition_weights:
            raise InputError(source, "transition_weights", "is empty")
        return settings


def build_path_pose(settings: PathPoseSettings, clusters: int, state_size: int) -> PathPose:
    """An untrained model of so many clusters."""
    return PathPose(
        clusters, state_size, settings.grid, settings.reach, settings.stride, settings.hidden, settings.dropout
    )


class PathPoseLearner:
    """A :class:`egopose.training.fitting.Learner`: poses are clustered at once, the classifier is what is fitted.

    Args:
        flow: ``[F, 2, S, S]`` of the whole store.
        states: ``[F, S]`` humanoid states z.
        fragments: training stretches, in global frames; the held-out frames are cut from their ends.
        settings: see :class:`PathPoseSettings`.
        batch: frames a step.
        validation_share: of each fragment, held out.
        seed: of clusters and network.
    """

    def __init__(
        self,
        flow: Any,
        states: Tensor,
        fragments: Sequence[Span],
        settings: PathPoseSettings,
        batch: int,
        validation_share: float,
        seed: int,
    ) -> None:
        self.settings, self.batch = settings, batch
        train, kept = split_validation(fragments, validation_share, settings.reach)
        rows = torch.cat([states[s.start : s.stop] for s in train])
        labels = cluster_poses(_angles(rows), settings.clusters, seed)
        clusters = int(labels.max()) + 1
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = build_path_pose(settings, clusters, states.shape[1])
        members = torch.as_tensor(labels)
        centres = torch.stack([rows[members == k].mean(dim=0) for k in range(clusters)])
        # Not the cluster itself but how near each is: 300 names of poses are learned by heart, their likeness is not.
        squared = torch.cdist(_angles_of(rows), _angles_of(centres)).square()
        self.targets = (-squared / squared.min(dim=1).values.mean().clamp_min(1e-6)).softmax(dim=1)
        self.model.centres.copy_(centres)
        ends = np.cumsum([s.stop - s.start for s in train])[:-1]
        costs = transition_costs(np.split(labels, ends), _angles(centres), settings.smoothing)
        self.model.transitions.copy_(torch.as_tensor(costs))
        self.egomotion = torch.cat([self.model.egomotion(flow[s.start : s.stop]) for s in train])
        self.model.feature_mean.copy_(self.egomotion.mean(dim=0))
        self.model.feature_std.copy_(self.egomotion.std(dim=0).clamp_min(1e-6))
        self.kept = [
            (self.model.egomotion(flow[s.start : s.stop])[skip:], states[s.start + skip : s.stop]) for s, skip in kept
        ]

    def loss(self, generator: torch.Generator, progress: float) -> tuple[Tensor, int]:
        """Cross entropy of random training frames, each wanting the clusters near its pose."""
        rows = torch.randint(len(self.targets), (self.batch,), generator=generator)
        return nn.functional.cross_entropy(self.model(self.egomotion[rows]), self.targets[rows]), self.batch

    @torch.no_grad()
    def held_out(self) -> float:
        """Expected distance (rad) of the clusters from the poses of held-out frames; NaN where none are held out."""
        if not self.kept:
            return math.nan
        chances = torch.cat([self.model(seen).softmax(dim=1) for seen, _ in self.kept])
        states = torch.cat([wanted for _, wanted in self.kept])
        return float((chances * torch.cdist(_angles_of(states), _angles_of(self.model.centres))).sum(dim=1).mean())

    def choose_weight(self) -> float:
        """Keep, among the weights of the settings, the one whose held-out paths are nearest to the true poses."""
        weights = self.settings.transition_weights
        chosen = min(weights, key=self._path_error) if self.kept else weights[0]
        self.model.transition_weight.fill_(chosen)
        return chosen

    def _path_error(self, weight: float) -> float:
        total, frames = 0.0, 0
        for seen, wanted in self.kept:
            result = self.model.centres[torch.as_tensor(self.model.path(seen, weight))]
            total += float((_angles_of(result) - _angles_of(wanted)).norm(dim=1).sum())
            frames += len(wanted)
        return total / frames


def _angles_of(states: Tensor) -> Tensor:
    """``[N, 4 + D]`` of z: the root's roll and pitch, as a quaternion, and the joint angles; what E_pose compares."""
    return states[:, StateLayout.of_size(states.shape[1]).rotation_and_angles].float()


def _angles(states: Tensor) -> np.ndarray:
    return _angles_of(states).double().numpy()
