"""Training the state regressor F on fragments of video and motion (Yuan & Kitani 2019, section 3.3).

A few minutes of motion are little: what is judged is the error on frames held out in time, cut from the training
fragments only, and the weights kept are those that were best there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn

from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.data.spans import Span, Window, split_validation, training_windows
from egopose.models.mirror import StateMirror
from egopose.models.predictions import Flow, predict_span, take_frames
from egopose.models.regressor import StateRegressor, state_statistics
from egopose.models.regressor_settings import RegressorSettings, learning_rate_at

State = dict[str, Tensor]


@dataclass(frozen=True)
class Progress:
    """One epoch's record. Errors are mean squared ones in normalised units; NaN where nothing is held out."""

    epoch: int
    epochs: int
    train_mse: float
    validation_mse: float
    seconds: float
    eta_seconds: float


@dataclass
class TrainingResult:
    """What training came to.

    Args:
        history: a record an epoch, epochs before a resume included.
        best_epoch: whose weights the model holds.
        validation_mse: of those weights on the held-out frames, NaN without any.
        mean_mse: of predicting the training mean there: what it must be compared with.
    """

    history: list[Progress] = field(default_factory=list)
    best_epoch: int = 0
    validation_mse: float = math.nan
    mean_mse: float = math.nan


class _Trainer:
    """The state of a run: model, running mean, optimiser, best weights; saved and taken back as flat tensors."""

    def __init__(self, model: StateRegressor, settings: RegressorSettings, input_std: float) -> None:
        self.model, self.settings, self.input_std = model, settings, input_std
        kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[settings.optimiser]
        decay = {"weight_decay": settings.weight_decay} if settings.optimiser == "adamw" else {}
        self.optimiser = kind(model.parameters(), lr=settings.learning_rate, **decay)
        self.mean_weights: State = _weights(model)
        self.best_weights: State = _weights(model)
        self.epoch = 0
        self.steps = 0
        self.result = TrainingResult()

    def state(self) -> State:
        """Everything needed to go on, as flat named tensors."""
        history = [[p.train_mse, p.validation_mse, p.seconds] for p in self.result.history]
        out = {
            "counters": torch.tensor([self.epoch, self.steps, self.result.best_epoch], dtype=torch.int64),
            "history": torch.tensor(history, dtype=torch.float64).reshape(-1, 3),
        }
        for label, weights in (
            ("model", _weights(self.model)),
            ("mean", self.mean_weights),
            ("best", self.best_weights),
        ):
            out |= {f"{label}/{k}": v.clone() for k, v in weights.items()}
        for index, parts in self.optimiser.state_dict()["state"].items():
            out |= {f"optimiser/{index}/{k}": torch.as_tensor(v).clone() for k, v in parts.items()}
        return out

    def load(self, state: State) -> None:
        """Goes on from :meth:`state`. Raises InputError where it is of another model."""
        part = {label: _under(state, label) for label in ("model", "mean", "best", "optimiser")}
        for label in ("model", "mean", "best"):
            for key, value in _weights(self.model).items():
                if key not in part[label] or part[label][key].shape != value.shape:
                    raise InputError("regressor state", f"{label}/{key}", "is missing or of another shape")
        self.model.load_state_dict(part["model"])
        self.mean_weights = {k: v.clone() for k, v in part["mean"].items()}
        self.best_weights = {k: v.clone() for k, v in part["best"].items()}
        moments: dict[int, State] = {}
        for key, value in part["optimiser"].items():
            index, name = key.split("/")
            moments.setdefault(int(index), {})[name] = value.clone()
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})
        self.epoch, self.steps, self.result.best_epoch = (int(v) for v in state["counters"])
        for epoch, (train_mse, validation_mse, seconds) in enumerate(state["history"].tolist(), 1):
            self.result.history.append(Progress(epoch, self.settings.epochs, train_mse, validation_mse, seconds, 0.0))
        if self.result.best_epoch:
            self.result.validation_mse = self.result.history[self.result.best_epoch - 1].validation_mse

    def run_epoch(self, flow: Flow, targets: Tensor, fragments: Sequence[Span], mirror: StateMirror | None) -> float:
        """One pass; returns the mean squared error while it learned."""
        generator = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + self.epoch)
        windows = training_windows(fragments, self.settings.fragment_length, self.settings.margin, generator)
        size = self.settings.batch_fragments
        batches = [windows[i : i + size] for i in range(0, len(windows), size)]
        self.model.train()
        total, frames = 0.0, 0
        for number, batch in enumerate(batches):
            progress = (self.epoch + number / len(batches)) / self.settings.epochs
            for group in self.optimiser.param_groups:
                group["lr"] = learning_rate_at(self.settings, progress)
            error, count = self._batch_error(batch, flow, targets, mirror, generator)
            self.optimiser.zero_grad(set_to_none=True)
            error.backward()
            if self.settings.gradient_clip is not None:
                nn.utils.clip_grad_norm_(self.model.parameters(), self.settings.gradient_clip)
            self.optimiser.step()
            self._update_mean()
            total, frames = total + error.item() * count, frames + count
        return total / frames

    def _batch_error(
        self,
        windows: Sequence[Window],
        flow: Flow,
        targets: Tensor,
        mirror: StateMirror | None,
        generator: torch.Generator,
    ) -> tuple[Tensor, int]:
        lengths = torch.tensor([w.stop - w.start for w in windows])
        frames = np.concatenate([np.arange(w.start, w.stop) for w in windows])
        fragment_of = torch.repeat_interleave(torch.arange(len(windows)), lengths)
        seen, states = take_frames(flow, frames), targets[torch.as_tensor(frames)].float()
        if mirror is not None:
            flip = (torch.rand(len(windows), generator=generator) < 0.5)[fragment_of]
            seen[flip] = mirror.flow(seen[flip])
            states[flip] = mirror.state(states[flip])
        seen = self._disturb(seen, fragment_of, len(windows), generator)
        # Only real frames pass the encoder: padding would enter its batch statistics.
        valid = torch.arange(int(lengths.max()))[None] < lengths[:, None]
        encoded = self.model.encode(seen)
        features = encoded.new_zeros(*valid.shape, encoded.shape[-1])
        features[valid] = encoded
        predicted = self.model.from_features(features, lengths)["normalised_state"][valid]
        wanted = _wanted(self.model, states, self.settings)
        counts = torch.cat([w.carries_loss() for w in windows])
        return (predicted - wanted)[counts].square().mean(), int(counts.sum())

    def _disturb(self, seen: Tensor, fragment_of: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if self.settings.flow_gain:
            gain = (self.settings.flow_gain * torch.randn(count, generator=generator)).exp()
            seen = seen * gain[fragment_of].reshape(-1, *[1] * (seen.ndim - 1))
        if self.settings.flow_noise:
            seen = seen + self.settings.flow_noise * self.input_std * torch.randn(seen.shape, generator=generator)
        return seen

    def _update_mean(self) -> None:
        self.steps += 1
        # A short memory at first: the start's random weights must not linger in the mean.
        decay = min(self.settings.ema_decay, self.steps / (self.steps + 10)) if self.settings.ema_decay else 0.0
        for key, value in self.model.state_dict().items():
            if value.is_floating_point():
                self.mean_weights[key].lerp_(value, 1 - decay)
            else:
                self.mean_weights[key].copy_(value)


def build_regressor(
    encoder: nn.Module | None,
    targets: Tensor,
    fragments: Sequence[Span],
    settings: RegressorSettings,
    feature_size: int = 128,
) -> StateRegressor:
    """An untrained F with the statistics of the frames :func:`train_regressor` will train on, validation left out.

    Args:
        encoder: flow to visual features, or None where features are the input. Its start is the caller's to seed.
        targets: ``[F, S]`` states z in their own units.
        fragments: training fragments, in global frames.
        settings: of network and training; ``seed`` sets the start of all but the encoder.
        feature_size: width of the visual features.
    """
    train, _ = split_validation(fragments, settings.validation_share, settings.margin)
    mean, std = state_statistics(torch.cat([targets[s.start : s.stop] for s in train]), settings.std_floor)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return StateRegressor(
            encoder,
            mean,
            std,
            feature_size,
            settings.context_size,
            settings.hidden,
            settings.dropout,
            settings.feature_dropout,
        )


def train_regressor(
    model: StateRegressor,
    flow: Flow,
    targets: Tensor,
    fragments: Sequence[Span],
    settings: RegressorSettings,
    mirror: StateMirror | None = None,
    progress: Callable[[Progress], None] | None = None,
    save: Callable[[State], None] | None = None,
    resume: State | None = None,
) -> TrainingResult:
    """Trains F in place; at the end it holds the best weights, in eval mode.

    Equal to the bit for equal arguments on one machine and thread count, resumed or not.

    Args:
        model: with the statistics of the training frames.
        flow: ``[F, 2, S, S]`` float16 memory map or tensor; features ``[F, D]`` where the model has no encoder.
        targets: ``[F, S]`` states z in their own units.
        fragments: training fragments, in global frames. Validation frames are cut from these.
        settings: of the training.
        mirror: needed where ``settings.mirror``.
        progress: called after each epoch.
        save: called every ``save_every`` epochs and at the end with flat named tensors, to be given back as ``resume``.
        resume: what ``save`` was given.

    Raises:
        InputError: no frames to train on, fragments outside the table, a mirror missing, a state of another model.
    """
    _check(flow, targets, fragments, settings, mirror)
    train, held_out = split_validation(fragments, settings.validation_share, settings.margin)
    with torch_threads(settings.threads), torch.random.fork_rng(devices=[]):
        sample = np.concatenate([np.arange(f.start, f.stop) for f in train])
        trainer = _Trainer(model, settings, float(take_frames(flow, sample[:: max(1, len(sample) // 512)]).std()))
        if resume is not None:
            trainer.load(resume)
        result = trainer.result
        while trainer.epoch < settings.epochs and not _out_of_patience(trainer, settings):
            began = time.perf_counter()
            # Dropout draws from torch's own generator; seeding it anew each epoch makes a resumed run the same run.
            torch.manual_seed(settings.seed * 1_000_003 + trainer.epoch)
            train_mse = trainer.run_epoch(flow, targets, train, mirror if settings.mirror else None)
            trainer.epoch += 1
            current = _weights(model)
            model.load_state_dict(trainer.mean_weights)
            validation_mse, result.mean_mse = _validation_error(model, flow, targets, held_out, settings)
            if math.isnan(validation_mse) or not validation_mse >= result.validation_mse:
                result.best_epoch, result.validation_mse = trainer.epoch, validation_mse
                trainer.best_weights = {k: v.clone() for k, v in trainer.mean_weights.items()}
            model.load_state_dict(current)
            seconds = time.perf_counter() - began
            eta = seconds * (settings.epochs - trainer.epoch)
            result.history.append(Progress(trainer.epoch, settings.epochs, train_mse, validation_mse, seconds, eta))
            if save is not None and trainer.epoch % settings.save_every == 0:
                save(trainer.state())
            if progress is not None:
                progress(result.history[-1])
        if save is not None:
            save(trainer.state())
        model.load_state_dict(trainer.best_weights)
        model.eval()
        _, result.mean_mse = _validation_error(model, flow, targets, held_out, settings)
    return result


def _wanted(model: StateRegressor, states: Tensor, settings: RegressorSettings) -> Tensor:
    """Normalised states, bounded: a hundredth of the frames can make a third of the joint velocities' squared error."""
    normalised = model.normalise(states)
    return normalised if settings.target_clip is None else normalised.clamp(-settings.target_clip, settings.target_clip)


def _validation_error(
    model: StateRegressor,
    flow: Flow,
    targets: Tensor,
    held_out: Sequence[tuple[Span, int]],
    settings: RegressorSettings,
) -> tuple[float, float]:
    """Mean squared error, and that of the training mean, over the judged frames; NaN where there are none."""
    if not held_out:
        return math.nan, math.nan
    model.eval()
    predicted, wanted = [], []
    for span, context in held_out:
        outputs = predict_span(model, flow, span, settings.encode_batch)
        predicted.append(outputs["normalised_state"][context:])
        wanted.append(_wanted(model, targets[span.start + context : span.stop], settings))
    truth = torch.cat(wanted)
    return (torch.cat(predicted) - truth).square().mean().item(), truth.square().mean().item()


def _out_of_patience(trainer: _Trainer, settings: RegressorSettings) -> bool:
    return settings.patience is not None and trainer.epoch - trainer.result.best_epoch >= settings.patience


def _check(
    flow: Flow, targets: Tensor, fragments: Sequence[Span], settings: RegressorSettings, mirror: StateMirror | None
) -> None:
    if len(flow) != len(targets):
        raise InputError("regressor", "flow", f"has {len(flow)} frames, the states have {len(targets)}")
    if not fragments:
        raise InputError("regressor", "fragments", "there are none to train on")
    for span in fragments:
        if not 0 <= span.start < span.stop <= len(targets):
            raise InputError("regressor", "fragments", f"{tuple(span)} is not inside 0..{len(targets)}")
    if settings.mirror and mirror is None:
        raise InputError("regressor", "mirror", "needs the skeleton's mirror")
    if settings.mirror and flow.ndim != 4:
        raise InputError("regressor", "mirror", "features have no mirror image: set it to false")


def _weights(model: nn.Module) -> State:
    return {k: v.detach().clone() for k, v in model.state_dict().items()}


def _under(state: State, label: str) -> State:
    return {k.removeprefix(f"{label}/"): v for k, v in state.items() if k.startswith(f"{label}/")}
