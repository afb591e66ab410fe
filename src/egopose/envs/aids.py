"""What makes the beginning of training easier, and is gone by its end: settings, and where a run stands in them.

Time is counted in control steps over all worlds of a run, as ``training.total_steps`` is. Only the environments that a
run collects in have aids: every other (evaluation, survival, estimation) is built without.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from egopose.core.config import from_mapping
from egopose.core.errors import InputError


def ramp(start: float, end: float, steps: int, taken: Tensor) -> Tensor:
    """From ``start`` to ``end`` in a straight line over ``steps`` control steps, and exactly ``end`` from then on.

    Args:
        taken: ``[n]`` control steps taken.

    Returns:
        ``[n]`` float64.
    """
    share = taken.double() / steps
    return torch.where(taken >= steps, end, start + (end - start) * share)


@dataclass(frozen=True)
class AdaptiveStartSettings:
    """See :class:`egopose.envs.starts.AdaptiveStarts`.

    Args:
        bin: frames whose episodes are judged together.
        unit: frames survived that halve how often a bin is drawn.
        rate: of the running estimate: the share of the newest episode in it.
        floor: share of the episodes that start uniformly.
    """

    bin: int
    unit: float
    rate: float
    floor: float


@dataclass(frozen=True)
class AssistSettings:
    """See :class:`egopose.envs.assist.RootAssistance`.

    Args:
        steps: control steps over which it goes to zero.
        stiffness, damping: of the height, N/m and N s/m.
        force_limit: N.
        turning_stiffness, turning_damping: of the lean, N m/rad and N m s/rad.
        torque_limit: N m.
    """

    steps: int
    stiffness: float
    damping: float
    force_limit: float
    turning_stiffness: float
    turning_damping: float
    torque_limit: float


@dataclass(frozen=True)
class FallSettings:
    """``head_drop`` (m) that training begins with; after ``steps`` control steps it is the task's."""

    head_drop: float
    steps: int


@dataclass(frozen=True)
class SigmaSettings:
    """``sigma`` (rad) that exploration begins with; after ``steps`` control steps it is the model's."""

    sigma: float
    steps: int


@dataclass(frozen=True)
class Aids:
    """The group ``conf/aids``; None for each that is not used."""

    starts: AdaptiveStartSettings | None = None
    assist: AssistSettings | None = None
    falls: FallSettings | None = None
    sigma: SigmaSettings | None = None

    @classmethod
    def from_config(cls, values: Mapping[str, Any] | None, source: str = "conf/aids") -> Aids:
        """From the resolved config group; None for no aids.

        Raises:
            InputError: a setting is missing, unknown or out of range; names it.
        """
        values = values or {}
        kinds: dict[str, Any] = {
            "starts": AdaptiveStartSettings,
            "assist": AssistSettings,
            "falls": FallSettings,
            "sigma": SigmaSettings,
        }
        if unknown := set(values) - set(kinds):
            raise InputError(source, sorted(unknown)[0], f"is not an aid; there are {', '.join(kinds)}")
        parts: dict[str, Any] = {
            name: from_mapping(kinds[name], part, f"{source}: {name}")
            for name, part in values.items()
            if part is not None
        }
        for name, part in parts.items():
            _check(part, f"{source}: {name}")
        return cls(**parts)


def _check(part: Any, source: str) -> None:
    for name in (f.name for f in fields(part)):
        value = getattr(part, name)
        if name in ("floor", "rate"):
            if not 0 < value <= 1:
                raise InputError(source, name, f"must lie above 0 and be at most 1, not {value}")
        elif name == "head_drop":
            continue
        elif value <= 0:
            raise InputError(source, name, f"must be positive, not {value}")
