"""The scene that the values of trained policies like best: Yu, Park & Lee 2021, section 5.3, equations 14 and 15.

A window's policy earns ``f_n(e) = V_n(s(t_n-1), e) - V_n(s(t_n), e)`` where the scene parameters are e. Their sum is
maximised by sequential least-squares programming (Kraft 1994), with the exact gradients of the value networks.

A warning: tracking alone is nearly blind to boxes that are too low, for a body may step down on them. Compare what
this finds with what a search in the simulator finds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from egopose.motion.rotations import Array
from egopose.scene.scene_file import Scene

#: f_n of scene parameters ``[P]``, a number; differentiable.
WindowValue = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class SceneFit:
    """What was found.

    Args:
        parameters: ``[P]`` e*, within [-1, 1].
        gains: ``[N]`` f_n there, and ``guessed [N]`` where the scene is as guessed (e = 0).
        slope: ``[P]`` of the sum at the guess.
        converged: whether the search ended by itself.
    """

    parameters: Array
    gains: Array
    guessed: Array
    slope: Array
    converged: bool


def fit_parameters(values: Sequence[WindowValue], size: int, starts: int = 8, seed: int = 0) -> SceneFit:
    """The e that maximises the sum of ``values``.

    Args:
        values: of each window.
        size: P.
        starts: where the search begins: once at the guess, else at random; the best is taken.
        seed: of these.

    Raises:
        ValueError: nothing is free, or there is no window.
    """
    if size < 1 or not values:
        raise ValueError("there must be a window, and something of the scene must be free")

    def each(e: NDArray[np.float64]) -> tuple[Array, Array]:
        at = torch.tensor(e, dtype=torch.float64, requires_grad=True)
        gains = torch.stack([value(at).double().reshape(()) for value in values])
        (slope,) = torch.autograd.grad(gains.sum(), at, allow_unused=True)
        return gains.detach().numpy(), np.zeros(size) if slope is None else slope.numpy()

    def cost(e: NDArray[np.float64]) -> tuple[float, Array]:
        gains, slope = each(e)
        return -float(gains.sum()), -slope

    rng = np.random.default_rng(seed)
    begins = [np.zeros(size), *rng.uniform(-1.0, 1.0, (starts - 1, size))]
    found = [minimize(cost, e, jac=True, method="SLSQP", bounds=[(-1.0, 1.0)] * size) for e in begins]
    best = min(found, key=lambda one: float(one.fun))
    parameters = np.clip(best.x, -1.0, 1.0)
    guessed, slope = each(np.zeros(size))
    return SceneFit(parameters, each(parameters)[0], guessed, slope, bool(best.success))


def changed_scene(scene: Scene, tops: Array, headings: Array) -> Scene:
    """The scene with its boxes there: ``tops [K, 3]`` m and ``headings [K]`` rad; what is free moves along.

    Ranges count from the new place.
    """
    boxes = []
    for box, top, heading in zip(scene.boxes, tops.tolist(), headings.tolist(), strict=True):
        place = (round(top[0], 3), round(top[1], 3))
        boxes.append(replace(box, place=place, height=round(top[2], 3), yaw=round(heading, 3)))
    return replace(scene, boxes=tuple(boxes))
