"""PathPose: the cheapest path, the transitions it pays for, and that egomotion finds the pose."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.data.spans import Span
from egopose.models.baselines.path_pose import cluster_poses, coarse_flow, transition_costs, viterbi, windows_around
from egopose.training.fitting import FitSettings, fit
from egopose.training.path_pose import PathPoseLearner, PathPoseSettings

SETTINGS = PathPoseSettings(3, 2, 2, 1, (16,), 0.0, 1.0, (1.0, 0.1))
FIT = FitSettings(1e-2, 0.0, 1.0, batch=32, validation_share=0.2, check_every=20, patience=50, threads=1)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5), st.integers(1, 4), st.integers(0, 2**31))
def test_viterbi_finds_the_cheapest_of_all_paths(frames: int, states: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    unary, pairwise = rng.normal(size=(frames, states)), rng.normal(size=(states, states))

    def cost(path: tuple[int, ...]) -> float:
        steps = sum(pairwise[a, b] for a, b in itertools.pairwise(path))
        return float(sum(unary[t, k] for t, k in enumerate(path)) + steps)

    best = min(itertools.product(range(states), repeat=frames), key=cost)
    assert cost(tuple(viterbi(unary, pairwise))) == pytest.approx(cost(best))


def test_transitions_are_counted_within_fragments_and_smoothed_towards_near_poses() -> None:
    centres = np.array([[0.0], [1.0], [5.0]])
    probability = np.exp(-transition_costs([np.array([0, 0, 1, 1]), np.array([2, 2])], centres, 1e-6))
    assert probability.sum(axis=1) == pytest.approx(np.ones(3))
    assert probability[0] == pytest.approx([0.5, 0.5, 0.0], abs=1e-5)
    assert probability[2] == pytest.approx([0.0, 0.0, 1.0], abs=1e-5)  # 1 -> 2 lies between two fragments
    smoothed = np.exp(-transition_costs([np.array([0, 0, 1, 1])], centres, 1.0))
    assert smoothed[0, 1] > smoothed[0, 2]


def test_flow_is_averaged_by_cells_and_its_window_ends_at_the_clip() -> None:
    flow = np.zeros((4, 2, 4, 4), dtype=np.float16)
    flow[2, 0, :2, 2:] = 8.0
    coarse = coarse_flow(flow[1:4], 2)
    assert coarse.shape == (3, 8)
    assert coarse[1].tolist() == [0, 8, 0, 0, 0, 0, 0, 0]
    assert windows_around(torch.arange(3)[:, None], 2, 2).tolist() == [[0, 0, 2], [0, 1, 2], [0, 2, 2]]


def test_poses_are_told_by_their_egomotion() -> None:
    states, flow = torch.zeros(300, 13), np.zeros((300, 2, 4, 4), dtype=np.float16)  # one joint
    kind = torch.arange(300) // 10 % 3
    states[:, 1], states[:, 5] = 1.0, kind.float()
    rng = np.random.default_rng(0)
    flow[:, 0] = kind.numpy()[:, None, None] * 0.1 + rng.normal(0, 0.05, size=(300, 4, 4))
    work = PathPoseLearner(flow, states, [Span(0, 150), Span(150, 300)], SETTINGS, 32, 0.2, seed=0)
    result = fit(work, FIT, seed=0, total_frames=6_000)
    assert work.choose_weight() in SETTINGS.transition_weights
    assert result.held_out < 0.3
    assert (work.model.states(flow)[:, 5] - states[:, 5]).abs().mean() < 0.1


def test_fewer_poses_than_clusters_and_settings_out_of_range() -> None:
    assert set(cluster_poses(np.array([[0.0], [4.0], [9.0]]), 10, seed=0)) <= {0, 1, 2}
    with pytest.raises(InputError, match="clusters"):
        PathPoseSettings.from_config({**vars(SETTINGS), "clusters": 1})
    with pytest.raises(InputError, match="transition_weights"):
        PathPoseSettings.from_config(vars(replace(SETTINGS, transition_weights=())))
