"""Training of the kinematic forecast: from what the state regressor sees to the motion that followed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from egopose.core.errors import InputError
from egopose.data.spans import Span, split_validation, without_block
from egopose.humanoid.state_layout import StateLayout
from egopose.models.mirror import StateMirror
from egopose.models.motion_forecast import MotionForecaster, spline_basis
from egopose.models.regressor import state_statistics
from egopose.training.forecaster_settings import ForecasterSettings
from egopose.training.kernel_forecast import Contexts


def build_forecaster(
    settings: ForecasterSettings, mean: Tensor, std: Tensor, fps: float, seed: int
) -> MotionForecaster:
    """An untrained network for pose states of these statistics ``[P]``, its start drawn from ``seed``."""
    count = spline_basis(settings.horizon + 1, settings.spacing, fps)[0].shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MotionForecaster(mean, std, settings.recurrent, settings.hidden, settings.dropout, count)


def cross_fit_starts(
    spans: Sequence[Span], blocks: Sequence[Sequence[Span]], settings: ForecasterSettings
) -> list[tuple[list[Span], Tensor]]:
    """For each block, what its networks learn from and the frames ``[N]`` whose forecasts they make.

    Together these are every frame with a context behind it. Networks learn from no frame of their forecasts' contexts
    and futures.

    Args:
        spans: takes' training frames.
        blocks: share them out; at most one stretch of each span in a block.
        settings: for context and horizon.
    """
    out = []
    for block in blocks:
        others = without_block(spans, block, settings.horizon, settings.context + 2)
        starts = [torch.zeros(0, dtype=torch.int64)]
        for piece in block:
            begin = next(s.start for s in spans if s.start <= piece.start < s.stop)
            first = min(max(piece.start, begin + settings.context - 1), piece.stop)
            starts.append(torch.arange(first, piece.stop))
        out.append((others, torch.cat(starts)))
    return out


class ForecastLearner:
    """A :class:`egopose.training.fitting.Learner` of windows of context and horizon.

    The loss is E_pose (Yuan & Kitani 2019, section 4.3) of every frame of the curve, root angles for small leans, and a
    little of all else a body needs to follow it.

    Args:
        contexts: as seen, by a state regressor that was not trained on the frames, from every frame of the fragments
            with so many before it.
        poses: ``[F, P]`` true ones.
        fragments: training stretches, in global frames; the held-out frames are cut from their ends.
        mirror: of pose states: every other window is its mirror image.
        hands: columns of the joint angles that belong to the hands.
        settings: of the network.
        fps: frames per second.
        batch: windows a step.
        validation_share: of each fragment, held out.
        seed: of the network's start.

    Raises:
        InputError: no fragment holds a context and two frames more.
    """

    def __init__(
        self,
        contexts: Contexts,
        poses: Tensor,
        fragments: Sequence[Span],
        mirror: StateMirror,
        hands: Sequence[int],
        settings: ForecasterSettings,
        fps: float,
        batch: int,
        validation_share: float,
        seed: int,
    ) -> None:
        self.settings, self.batch = settings, batch
        train, kept = split_validation(fragments, validation_share, settings.context)
        self.train = torch.tensor([list(s) for s in train if s.stop - s.start >= settings.context + 2]).reshape(-1, 2)
        if len(self.train) == 0:
            raise InputError("forecaster", "fragments", f"none is longer than {settings.context} + 2 frames")
        rows = torch.cat([poses[a:b] for a, b in self.train.tolist()])
        self.model = build_forecaster(settings, *state_statistics(rows, settings.std_floor), fps, seed)
        self.contexts = Contexts(self.model.normalise(contexts.rows), contexts.row)
        self.poses, self.mirror = self.model.normalise(poses), mirror
        self.basis = spline_basis(settings.horizon + 1, settings.spacing, fps)[0]
        self.judged, self.others = _scales(self.model.std, hands)
        self.windows = self._windows([span for span, _ in kept], settings.context)

    def loss(self, generator: torch.Generator, progress: float) -> tuple[Tensor, int]:
        """E_pose and the rest of a batch of random windows; ``progress`` is not read."""
        spans = self.train[self._draw(generator)]
        first, last = spans[:, 0] + self.settings.context - 1, spans[:, 1] - 2
        now = first + (torch.rand(self.batch, generator=generator) * (last - first + 1)).long()
        seen, flip = self.contexts[now], torch.rand(self.batch, generator=generator) < 0.5
        scale = self.settings.input_noise
        seen = seen + scale * torch.randn(len(now), 1, seen.shape[-1], generator=generator)
        seen = seen + scale * torch.randn(seen.shape, generator=generator)
        judged, others, inside = self._errors(seen, now, spans[:, 1], flip)
        loss = (judged + self.settings.other_weight * others)[inside].mean()
        return loss, int(inside.sum()) + len(now) * (self.settings.context - 1)

    @torch.no_grad()
    def held_out(self) -> float:
        """E_pose, rad, of the curves from held-out contexts; NaN where there are none."""
        if not len(self.windows):
            return math.nan
        now, stops = self.windows.unbind(1)
        judged, _, inside = self._errors(self.contexts[now], now, stops, torch.zeros(len(now), dtype=torch.bool))
        return float(judged[inside].mean())

    def _errors(self, seen: Tensor, now: Tensor, stops: Tensor, flip: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """E_pose and the mean square of what it leaves out ``[B, T]``, and which frames the take has ``[B, T]``."""
        curve = self.basis @ self.model(self._mirrored(seen, flip))
        frames = now[:, None] + torch.arange(len(self.basis))
        inside = frames < stops[:, None]
        error = curve - self._mirrored(self.poses[torch.minimum(frames, stops[:, None] - 1)], flip)
        judged = ((error * self.judged).square().sum(-1) + 1e-6).sqrt()
        return judged, (error.square() * self.others).sum(-1) / self.others.sum(), inside

    def _mirrored(self, poses: Tensor, flip: Tensor) -> Tensor:
        """Rows ``[B, T, P]`` in deviations, their mirror images where ``flip [B]``."""
        image = self.model.normalise(self.mirror.state(poses * self.model.std + self.model.mean))
        return torch.where(flip[:, None, None], image, poses)

    def _draw(self, generator: torch.Generator) -> Tensor:
        """``[batch]`` fragments, each as often as forecasts can begin in it."""
        starts = (self.train[:, 1] - self.train[:, 0] - self.settings.context).double()
        return torch.multinomial(starts, self.batch, replacement=True, generator=generator)

    def _windows(self, spans: Sequence[Span], context: int) -> Tensor:
        """``[W, 2]`` last frame of each context, and where its fragment ends; one window every half context."""
        step = max(1, context // 2)
        windows = [[at, s.stop] for s in spans for at in range(s.start + context - 1, s.stop - 2, step)]
        return torch.tensor(windows, dtype=torch.int64).reshape(-1, 2)


def _scales(std: Tensor, hands: Sequence[int]) -> tuple[Tensor, Tensor]:
    """``[P]`` what errors in deviations are multiplied by in E_pose, and ``[P]`` which numbers it leaves out (0 or 1).

    A small lean is twice the quaternion's x and y; w and z follow from these.
    """
    layout = StateLayout.of_pose_size(len(std))
    judged, others = std.clone(), torch.zeros_like(std)
    for left_out in (layout.root_height, layout.root_velocity):
        judged[left_out], others[left_out] = 0.0, 1.0
    judged[layout.root_rotation] = std[layout.root_rotation] * torch.tensor([0.0, 2.0, 2.0, 0.0])
    joints, other_joints = judged[layout.joint_angles], others[layout.joint_angles]
    for hand in hands:
        joints[hand], other_joints[hand] = 0.0, 1.0
    return judged, others
