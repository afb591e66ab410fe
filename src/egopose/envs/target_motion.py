"""The motion that bodies follow, as policies and planners read it: a table of all frames, or kinematic forecasts.

Both are a :class:`~egopose.envs.problem.TargetMotion`, so nobody else asks which of them it is.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.envs.problem import Followed, TargetMotion, global_frame
from egopose.envs.reference_forecasts import ReferenceForecasts

_NOW = np.zeros(1, dtype=np.int64)


class TableMotion:
    """Of every frame of a store, take by take.

    Args:
        states: ``[F, S]`` humanoid states.
        path: ``[F, 3]`` x, y (m) and heading (rad) of their root; each take may have a world of its own.
        last: ``[F]`` int64, the last frame of each frame's take.
    """

    def __init__(self, states: Tensor, path: Tensor, last: Tensor) -> None:
        self.size, self._last = states.shape[1], last.numpy()
        self.put(states, path)

    def put(self, states: Tensor, path: Tensor) -> None:
        """Other states and another path for the same frames. A live stream knows a few at a time."""
        self._states, self._path = states.float().numpy(), path.double().numpy()

    def states(self, entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> NDArray[np.float32]:
        """See :class:`~egopose.envs.problem.TargetMotion`."""
        return self._states[self._rows(entries, ahead)]

    def path(self, entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> NDArray[np.float64]:
        """See :class:`~egopose.envs.problem.TargetMotion`."""
        return self._path[self._rows(entries, ahead)]

    def followed(self, starts: Tensor | None = None) -> Followed:
        """The whole table, wherever episodes begin."""
        return Followed(torch.from_numpy(self._states), global_frame, torch.from_numpy(self._path))

    def _rows(self, entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> NDArray[np.int64]:
        frame = entries["frame"].numpy().reshape(-1, 1)
        return np.minimum(frame + ahead, self._last[frame])


class CurveMotion:
    """Of forecasts: each body follows the curve that begins where its episode does.

    Args:
        forecasts: their curves may change at any time.
    """

    def __init__(self, forecasts: ReferenceForecasts) -> None:
        self.size, self._forecasts = forecasts.size, forecasts

    def states(self, entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> NDArray[np.float32]:
        """See :class:`~egopose.envs.problem.TargetMotion`."""
        found: NDArray[np.float32] = self._forecasts.states(*_clock(entries, ahead)).numpy()
        return found.reshape(-1, len(ahead), self.size)

    def path(self, entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> NDArray[np.float64]:
        """See :class:`~egopose.envs.problem.TargetMotion`."""
        found: NDArray[np.float64] = self._forecasts.path(*_clock(entries, ahead)).numpy()
        return found.reshape(-1, len(ahead), 3)

    def followed(self, starts: Tensor | None = None) -> Followed:
        """Every step of the curves that begin at global frames ``starts [W]``, each once; None for all curves."""
        forecasts = self._forecasts
        begun = forecasts.starts if starts is None else starts
        count = forecasts.horizon + 1
        clock = begun.repeat_interleave(count), torch.arange(count).repeat(len(begun))
        number = torch.full((forecasts.frames,), -1, dtype=torch.int64)
        number[begun] = torch.arange(len(begun))

        def row(entries: Mapping[str, Tensor]) -> Tensor:
            start, step = entries["episode_start"].squeeze(-1), entries["episode_step"].squeeze(-1)
            return number[start] * count + step.clamp(max=forecasts.horizon)

        return Followed(forecasts.states(*clock), row, forecasts.path(*clock))


def present_path(motion: TargetMotion, entries: Mapping[str, Tensor]) -> Tensor:
    """``[N, 3]`` x, y (m) and heading (rad) of the target motion's root now, float64."""
    return torch.from_numpy(motion.path(entries, _NOW)[:, 0])


def _clock(entries: Mapping[str, Tensor], ahead: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
    """Starts and steps ``[N * K]``."""
    step = entries["episode_step"].reshape(-1, 1) + torch.from_numpy(ahead)
    return entries["episode_start"].reshape(-1, 1).expand_as(step).flatten(), step.flatten()
