"""The scene by values: found where it is known, within its bounds, with the gradients it is given."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from egopose.scene.fitting import WindowValue, changed_scene, fit_parameters
from egopose.scene.scene_file import Box, Scene


def bowl(best: list[float], weight: float, rows: list[int]) -> WindowValue:
    """A value that is highest where these parameters are ``best``."""
    target = torch.tensor(best, dtype=torch.float64)

    def value(e: Tensor) -> Tensor:
        return 3.0 - weight * (e[rows] - target).square().sum()

    return value


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-1.6, 1.6), min_size=3, max_size=3))
def test_a_known_quadratic_is_found_within_its_bounds(best: list[float]) -> None:
    fit = fit_parameters([bowl(best[:2], 2.0, [0, 1]), bowl(best[2:], 0.5, [2])], 3)
    np.testing.assert_allclose(fit.parameters, np.clip(best, -1, 1), atol=1e-4)
    assert fit.converged
    assert fit.gains.sum() >= fit.guessed.sum() - 1e-9
    np.testing.assert_allclose(fit.slope, [4 * best[0], 4 * best[1], best[2]], atol=1e-9)


def test_windows_that_share_a_box_agree_on_it() -> None:
    """Twice as sure at 0.6 than at 0: 0.4."""
    fit = fit_parameters([bowl([0.6], 2.0, [0]), bowl([0.0], 1.0, [0])], 1)
    assert fit.parameters[0] == pytest.approx(0.4, abs=1e-5)
    assert fit.guessed.tolist() == pytest.approx([3 - 2 * 0.36, 3.0])


def test_another_start_finds_the_higher_of_two_hills() -> None:
    def value(e: Tensor) -> Tensor:
        hills = 1.0 * torch.exp(-40 * (e + 0.1).square()) + 2.0 * torch.exp(-40 * (e - 0.8).square())
        return hills.sum()

    assert fit_parameters([value], 1, starts=1).parameters[0] == pytest.approx(-0.1, abs=0.02)
    assert fit_parameters([value], 1, starts=16).parameters[0] == pytest.approx(0.8, abs=0.02)


def test_gradients_pass_through_a_network() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(2, 16), nn.Tanh(), nn.Linear(16, 1))
    fit = fit_parameters([lambda e: network(e.float())[0]], 2, starts=6)
    grid = torch.stack(torch.meshgrid(torch.linspace(-1, 1, 41), torch.linspace(-1, 1, 41), indexing="ij"), -1)
    assert fit.gains.sum() >= network(grid).max().item() - 1e-3


def test_nothing_free_is_refused() -> None:
    with pytest.raises(ValueError, match="something of the scene must be free"):
        fit_parameters([bowl([0.0], 1.0, [0])], 0)


def test_the_found_scene_is_a_scene_file() -> None:
    scene = Scene(boxes=(Box("step", (0.4, 0.8), (1.0, 0.0), 0.2, 0.0, {"height": (-0.1, 0.3)}),))
    found = changed_scene(scene, np.array([[1.0, 0.25, 0.3333333]]), np.array([0.1]))
    box = found.box("step")
    assert (box.place, box.height, box.yaw, box.free) == ((1.0, 0.25), 0.333, 0.1, {"height": (-0.1, 0.3)})
