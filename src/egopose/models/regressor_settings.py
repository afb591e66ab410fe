"""How the state regressor is built and trained: the group ``conf/regressor``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from egopose.core.errors import InputError


@dataclass(frozen=True)
class RegressorSettings:
    """The group ``conf/regressor``; each file gives every value and its source.

    Args:
        hidden, context_size, dropout, feature_dropout: see :class:`StateRegressor`.
        std_floor: see :func:`egopose.models.regressor.state_statistics`.
        target_clip: normalised states are clipped to +- this in training and in the validation error, or None.
        fragment_length: frames the BiLSTM sees in training.
        margin: frames at either end of a fragment that carry no loss, unless the video begins or ends there.
        epochs: passes over the training frames.
        batch_fragments: fragments a step.
        optimiser: ``adam`` or ``adamw``.
        learning_rate: at its height.
        weight_decay: ``adamw`` only.
        schedule: ``constant`` or ``one_cycle`` (linear up over ``warmup`` of the steps, cosine down to nothing).
        warmup: share of the steps.
        gradient_clip: norm, or None.
        flow_noise: standard deviation added to the input, in units of the training input's own.
        flow_gain: standard deviation of a log-normal gain, one a fragment.
        mirror: exchange left and right in half of the fragments.
        ema_decay: of the weights' running mean, a step; 0 takes the weights themselves.
        validation_share: of each training fragment's end, held out; 0 for none.
        patience: epochs without a better validation error before training stops, or None.
        seed: of every random draw.
        threads: of torch while training and predicting.
        save_every: epochs between calls of ``save``.
        encode_batch: frames a forward pass of the encoder without gradients.
        lookahead: frames the causal predictions may see ahead.
        cross_fit: a training frame's predictions come from an F that never saw it, one of so many, each trained on the
            other blocks of time; 1: from the F that learned it.
    """

    hidden: tuple[int, ...]
    context_size: int
    dropout: float
    feature_dropout: float
    std_floor: float
    target_clip: float | None
    fragment_length: int
    margin: int
    epochs: int
    batch_fragments: int
    optimiser: str
    learning_rate: float
    weight_decay: float
    schedule: str
    warmup: float
    gradient_clip: float | None
    flow_noise: float
    flow_gain: float
    mirror: bool
    ema_decay: float
    validation_share: float
    patience: int | None
    seed: int
    threads: int
    save_every: int
    encode_batch: int
    lookahead: int
    cross_fit: int

    def __post_init__(self) -> None:
        def check(ok: bool, name: str, cause: str) -> None:
            if not ok:
                raise InputError("regressor", name, cause)

        check(self.optimiser in ("adam", "adamw"), "optimiser", "must be adam or adamw")
        check(self.schedule in ("constant", "one_cycle"), "schedule", "must be constant or one_cycle")
        check(self.cross_fit >= 1, "cross_fit", "must be at least 1")
        check(self.fragment_length > 2 * self.margin >= 0, "margin", "must leave frames of the fragment")
        check(0 <= self.validation_share < 0.5, "validation_share", "must lie in [0, 0.5)")
        check(0 <= self.ema_decay < 1, "ema_decay", "must lie in [0, 1)")
        check(self.patience is None or self.validation_share > 0, "patience", "needs a validation_share")
        check(min(self.epochs, self.batch_fragments, self.threads, self.save_every) > 0, "epochs", "must be positive")


def learning_rate_at(settings: RegressorSettings, progress: float) -> float:
    """Learning rate at ``progress`` 0..1 of all steps."""
    if settings.schedule == "constant":
        return settings.learning_rate
    if progress < settings.warmup:
        return settings.learning_rate * max(progress / settings.warmup, 0.04)
    return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * (progress - settings.warmup) / (1 - settings.warmup)))
