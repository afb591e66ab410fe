"""Frame by frame as of the whole video."""

from __future__ import annotations

import torch

from egopose.inference.causal import CausalRegression
from egopose.models.regressor import StateRegressor

LOOKAHEAD = 3


@torch.no_grad()
def assert_frame_by_frame_as_the_video_up_to_there(model: StateRegressor, features: torch.Tensor) -> None:
    """Visual features ``[T, D]`` pushed one by one, and causally at once, say what a video does that ends later."""
    frames = len(features)
    causal = CausalRegression(model, torch.tensor([[-9.0, 9.0]]).repeat(52, 1), LOOKAHEAD)
    rows = [row for t in range(frames) if (row := causal.push(t, features[t])) is not None] + list(causal.drain())
    at_once = model.from_features(features[None], lookahead=LOOKAHEAD)["humanoid_state"][0]
    known = [model.from_features(features[None, : t + 1])["humanoid_state"][0] for t in range(frames)]
    assert len(rows) == frames
    for t, row in enumerate(rows):
        end = min(t + LOOKAHEAD, frames - 1)
        torch.testing.assert_close(row.humanoid_state, known[end][t], atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(at_once[t], known[end][t], atol=1e-5, rtol=1e-4)
