"""The two training schemes of recurrent forecasters: noise on the input (ERD), alternation (acLSTM)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.spans import Span, split_validation
from egopose.models.baselines.recurrent import RecurrentForecaster, ground_truth_mask
from egopose.models.mirror import StateMirror
from egopose.models.regressor import state_statistics

SCHEMES = ("noise", "alternate")


@dataclass(frozen=True)
class RecurrentSettings:
    """``conf/baseline/erd.yaml`` and ``aclstm.yaml``, without their ``optimiser``.

    Args:
        encoder, recurrent, layers, decoder, residual: see :class:`RecurrentForecaster`.
        scheme: ``noise`` (ERD) or ``alternate`` (acLSTM).
        input_noise: with ``noise``, its standard deviation in deviations, at its height.
        noise_ramp: share of the training after which it is reached.
        truth, own: with ``alternate``, see :func:`ground_truth_mask`.
        context, horizon: frames given and frames forecast; a training window has both.
        std_floor: of the deviations poses are divided by.
        mirror: half of the training windows are mirror images.
    """

    encoder: tuple[int, ...]
    recurrent: int
    layers: int
    decoder: tuple[int, ...]
    residual: bool
    scheme: str
    input_noise: float
    noise_ramp: float
    truth: int
    own: int
    context: int
    horizon: int
    std_floor: float
    mirror: bool = False

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/baseline") -> RecurrentSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        settings = from_mapping(cls, values, source)
        if settings.scheme not in SCHEMES:
            raise InputError(source, "scheme", f"must be one of {', '.join(SCHEMES)}, not {settings.scheme!r}")
        least = ["context", "horizon", "recurrent", "layers"]
        for name in [*least, *(("truth",) if settings.scheme == "alternate" else ())]:
            if getattr(settings, name) < 1:
                raise InputError(source, name, f"must be at least 1, not {getattr(settings, name)}")
        return settings


def build_forecaster(settings: RecurrentSettings, mean: Tensor, std: Tensor, seed: int) -> RecurrentForecaster:
    """An untrained network for pose states of these statistics ``[P]``, its start drawn from ``seed``."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return RecurrentForecaster(
            mean, std, settings.encoder, settings.recurrent, settings.layers, settings.decoder, settings.residual
        )


class RecurrentLearner:
    """A :class:`egopose.training.fitting.Learner` of windows of context and horizon.

    Args:
        poses: ``[F, P]`` pose states of all frames.
        fragments: training stretches, in global frames; the held-out frames are cut from their ends.
        settings: network and scheme.
        batch: windows a step.
        validation_share: of each fragment, held out.
        seed: of the network's start.
        mirror: of pose states; None where no window is to be mirrored.

    Raises:
        InputError: no fragment has two frames.
    """

    def __init__(
        self,
        poses: Tensor,
        fragments: Sequence[Span],
        settings: RecurrentSettings,
        batch: int,
        validation_share: float,
        seed: int,
        mirror: StateMirror | None = None,
    ) -> None:
        self.settings, self.batch = settings, batch
        train, kept = split_validation(fragments, validation_share, settings.context)
        self.train = torch.tensor([list(s) for s in train if s.stop - s.start >= 2])
        if len(self.train) == 0:
            raise InputError("baseline", "fragments", "there are none of two frames or more to train on")
        rows = torch.cat([poses[a:b] for a, b in self.train.tolist()])
        self.model = build_forecaster(settings, *state_statistics(rows, settings.std_floor), seed)
        self.poses = self.model.normalise(poses)
        self.images = None if mirror is None else self.model.normalise(mirror.state(poses))
        self.windows = self._held_out_windows([span for span, _ in kept])

    def loss(self, generator: torch.Generator, progress: float) -> tuple[Tensor, int]:
        """Mean squared error of every next pose of a batch of random windows, in deviations."""
        length = self.settings.context + self.settings.horizon
        spans = self.train[self._draw(generator)]
        starts, stops = spans.unbind(1)
        room = (stops - starts - length).clamp(min=0) + 1
        starts = starts + (torch.rand(self.batch, generator=generator) * room).long()
        frames = starts[:, None] + torch.arange(length)
        inside = frames < stops[:, None]
        frames = torch.minimum(frames, stops[:, None] - 1)
        poses = self.poses[frames]
        if self.images is not None:
            flip = torch.rand(self.batch, generator=generator) < 0.5
            poses = torch.where(flip[:, None, None], self.images[frames], poses)
        given, wanted = poses[:, :-1], poses[:, 1:]
        if self.settings.scheme == "alternate":
            truth = ground_truth_mask(length - 1, self.settings.truth, self.settings.own)
            out = self.model.conditioned(given, truth)
        else:
            ramp = min(1.0, progress / self.settings.noise_ramp) if self.settings.noise_ramp > 0 else 1.0
            noise = torch.randn(given.shape, generator=generator)
            out, _ = self.model.forward(given + self.settings.input_noise * ramp * noise)
        return (out - wanted)[inside[:, 1:]].square().mean(), int(inside.sum())

    @torch.no_grad()
    def held_out(self) -> float:
        """Mean squared error, in deviations, of whole forecasts from held-out contexts: what is asked at test time."""
        if not len(self.windows):
            return math.nan
        starts, stops = self.windows.unbind(1)
        context, horizon = self.settings.context, self.settings.horizon
        given = self.poses[starts[:, None] + torch.arange(context)]
        out = self.model.normalise(self.model.forecast(self.model.denormalise(given), horizon))
        frames = starts[:, None] + context + torch.arange(horizon)
        inside = frames < stops[:, None]
        wanted = self.poses[torch.minimum(frames, stops[:, None] - 1)]
        return float((out - wanted)[inside].square().mean())

    def _draw(self, generator: torch.Generator) -> Tensor:
        """``[batch]`` fragments, each as often as it has frames."""
        lengths = (self.train[:, 1] - self.train[:, 0]).double()
        return torch.multinomial(lengths, self.batch, replacement=True, generator=generator)

    def _held_out_windows(self, spans: Sequence[Span]) -> Tensor:
        """``[W, 2]`` first frame of each context, and where its fragment ends; one window every context."""
        step = self.settings.context
        windows = [[at, span.stop] for span in spans for at in range(span.start, span.stop - step - 1, step)]
        return torch.tensor(windows, dtype=torch.int64).reshape(-1, 2)
