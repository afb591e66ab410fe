"""When to give up on the humanoid's state and restart it from the regressor's (Yuan & Kitani 2019, section 3.3).

Three modes. ``value``: reset when ``V(s_t) < reset_threshold * V_mean`` (the paper's kappa), V_mean the running mean
of V over the take so far. ``naive``: reset when the humanoid has fallen, its head under a height. ``off``: never.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from egopose.core.errors import InputError
from egopose.envs.mdp import rotations as rot

MODES = ("value", "naive", "off")
#: Yuan & Kitani 2019, sections 3.3 and 4: reset_threshold, and the discount their values have.
PAPER_THRESHOLD, PAPER_DISCOUNT = 0.6, 0.95


@dataclass(frozen=True)
class FailSafeSettings:
    """``failsafe`` of ``conf/evaluate.yaml`` and ``conf/estimate.yaml``.

    Args:
        mode: one of ``value``, ``naive``, ``off``.
        reset_threshold: fraction of the mean value under which the state counts as unstable; None for
            :func:`paper_threshold` of the discount the values were learned with, see :meth:`for_run`.
        fallen_height: head height (m) under which the humanoid counts as fallen, for ``naive``.
        restart: ``own``: the humanoid restarts at its own place and heading (the paper); ``path``: at those of the path
            that is followed, see :mod:`egopose.inference.followed_path`.
        stray_distance: m from the path, and stray_heading: degrees off it, beyond which a body is lost and restarts on
            it; None for never.

    Raises:
        InputError: an unknown mode or restart; a limit that is not positive, or one without a path to restart on.
    """

    mode: str
    reset_threshold: float | None
    fallen_height: float
    restart: str = "own"
    stray_distance: float | None = None
    stray_heading: float | None = None

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise InputError("failsafe", "mode", f"must be one of {', '.join(MODES)}, not {self.mode!r}")
        if self.restart not in ("own", "path"):
            raise InputError("failsafe", "restart", f"must be own or path, not {self.restart!r}")
        for name in ("stray_distance", "stray_heading"):
            limit = getattr(self, name)
            if limit is not None and not (limit > 0 and self.restart == "path"):
                raise InputError("failsafe", name, f"{limit}; must be positive, and needs restart=path, or null")

    def for_run(self, config: Mapping[str, Any], planned: float | None = None) -> FailSafeSettings:
        """With a threshold: its own, else ``planned`` (meant for a planner's values), else the one of the run's task
        (``task.reset_threshold``), else the paper's, which depends on the run's discount.

        Args:
            config: of the run, resolved.
            planned: of a planner; None without one, or where it has none.
        """
        if self.reset_threshold is not None:
            return self
        known = planned if planned is not None else config.get("task", {}).get("reset_threshold")
        return replace(
            self, reset_threshold=paper_threshold(float(config["algo"]["gamma"])) if known is None else known
        )


def paper_threshold(discount: float) -> float:
    """The paper's threshold (its kappa) of .6 belongs to its discount of .95; this is the one for another discount.

    At an even reward r, a state whose episode ends in n frames has value ``r (1 - discount^n) / (1 - discount)``. One
    that goes on for ever has ``r / (1 - discount)``. The first is kappa times the second n frames before the end, with
    ``kappa = 1 - discount^n``. The same n is kept, 17.9 frames; at a discount of .99 the threshold becomes .164.

    Raises:
        InputError: a discount that is not between 0 and 1.
    """
    if not 0.0 < discount < 1.0:
        raise InputError(
            "algo", "gamma", f"must lie between 0 and 1 for the fail-safe's reset_threshold, not {discount}"
        )
    return 1.0 - (1.0 - PAPER_THRESHOLD) ** (math.log(discount) / math.log(PAPER_DISCOUNT))


class FailSafe:
    """The fail-safe of N worlds that run side by side, one take each.

    Args:
        num_envs: N.
        settings: see :class:`FailSafeSettings`; with a reset_threshold.

    Raises:
        ValueError: there is no reset_threshold.

    Attributes:
        confidence: list over calls of ``[N]`` float64: V(s_t) over its running mean (1 at the first frame; NaN for
            worlds that were not active).
    """

    def __init__(self, num_envs: int, settings: FailSafeSettings) -> None:
        if settings.reset_threshold is None:
            raise ValueError("reset_threshold is not known: take settings.for_run(...)")
        self.settings, self._kappa = settings, settings.reset_threshold
        self.confidence: list[Tensor] = []
        self._sum = torch.zeros(num_envs, dtype=torch.float64)
        self._count = torch.zeros(num_envs, dtype=torch.float64)

    def update(self, value: Tensor, head_height: Tensor, active: Tensor) -> Tensor:
        """Record a frame and say which worlds must be reset.

        Every frame of the take counts in the mean, also this one and those that triggered. So a stretch with low values
        throughout lowers the threshold, and does not reset the body at every frame. A mean that is not positive says
        nothing of a drop, and nothing triggers then.

        Args:
            value: ``[N]`` V(s_t).
            head_height: ``[N]`` metres above the ground.
            active: ``[N]`` bool, worlds whose take still runs.

        Returns:
            ``[N]`` bool.
        """
        value = value.detach().to(torch.float64)
        self._sum += torch.where(active, value, torch.zeros_like(value))
        self._count += active
        mean = self._sum / self._count.clamp(min=1)
        ratio = torch.where(mean > 0, value / mean, torch.ones_like(value))
        self.confidence.append(torch.where(active, ratio, torch.full_like(ratio, float("nan"))))
        return active & self._unstable(ratio, head_height)

    def strayed(self, place: Tensor, heading: Tensor, path_place: Tensor, path_heading: Tensor) -> Tensor:
        """``[N]`` bool: bodies at ``place [N, 2]`` m, facing ``heading [N]`` rad, that lost the path they follow."""
        distance, turn = self.settings.stray_distance, self.settings.stray_heading
        lost = torch.zeros(len(place), dtype=torch.bool)
        if distance is not None:
            lost |= (place - path_place).norm(dim=-1) > distance
        if turn is not None:
            lost |= rot.wrapped(heading - path_heading).abs() > math.radians(turn)
        return lost

    def _unstable(self, ratio: Tensor, head_height: Tensor) -> Tensor:
        if self.settings.mode == "value":
            return ratio < self._kappa
        if self.settings.mode == "naive":
            return head_height < self.settings.fallen_height
        return torch.zeros_like(ratio, dtype=torch.bool)
