"""Training of the methods compared with: gradient steps under one budget, the best weights on held-out frames kept."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads

State = dict[str, Tensor]


@dataclass(frozen=True)
class FitSettings:
    """The group ``optimiser`` of a file of ``conf/baseline``.

    Args:
        learning_rate: AdamW's, at its start; a cosine takes it to nothing at the budget's end.
        weight_decay: AdamW's.
        gradient_clip: norm.
        batch: windows (or frames) a step.
        validation_share: of each training fragment's end, held out.
        check_every: steps between looks at the held-out frames.
        patience: looks without a better one before training ends.
        threads: of torch.
    """

    learning_rate: float
    weight_decay: float
    gradient_clip: float
    batch: int
    validation_share: float
    check_every: int
    patience: int
    threads: int

    @classmethod
    def from_config(cls, values: Mapping[str, Any]) -> FitSettings:
        """Raises InputError: a key is missing, unknown or out of range; names it."""
        settings = from_mapping(cls, values, "conf/baseline: optimiser")
        for name in ("batch", "check_every", "patience", "threads"):
            if getattr(settings, name) < 1:
                raise InputError("conf/baseline: optimiser", name, f"must be at least 1, not {getattr(settings, name)}")
        if not 0.0 <= settings.validation_share < 1.0:
            raise InputError("conf/baseline: optimiser", "validation_share", "must lie in 0..1")
        return settings


class Learner(Protocol):
    """What :func:`fit` trains."""

    @property
    def model(self) -> nn.Module:
        """In normalised units or whatever its own are; its state dict is what is kept."""
        ...

    def loss(self, generator: torch.Generator, progress: float) -> tuple[Tensor, int]:
        """The loss of a fresh batch and how many frames of motion it holds; ``progress`` is the share of the budget."""
        ...

    def held_out(self) -> float:
        """The model's error on held-out frames; NaN where none are."""
        ...


@dataclass
class FitResult:
    """What training came to: ``reason`` is ``total_steps``, ``patience``, ``max_seconds`` or ``interrupted``.

    ``history`` has a row ``(frames, loss, held_out)`` a look; ``held_out`` is that of the weights kept.
    """

    reason: str = ""
    steps: int = 0
    frames: int = 0
    held_out: float = math.nan
    history: list[tuple[int, float, float]] = field(default_factory=list)


class Fit:
    """The state of a training: weights, the best of them, optimiser and counters, as flat tensors."""

    def __init__(self, learner: Learner, settings: FitSettings) -> None:
        self.learner, self.settings = learner, settings
        self.optimiser = torch.optim.AdamW(
            learner.model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.best = _weights(learner.model)
        self.since_best = 0
        self.result = FitResult()

    def state(self) -> State:
        """Everything needed to go on."""
        result = self.result
        out = {
            "counters": torch.tensor([result.steps, result.frames, self.since_best], dtype=torch.int64),
            "held_out": torch.tensor(result.held_out, dtype=torch.float64),
            "history": torch.tensor(result.history, dtype=torch.float64).reshape(-1, 3),
        }
        for label, weights in (("model", _weights(self.learner.model)), ("best", self.best)):
            out |= {f"{label}/{key}": value.clone() for key, value in weights.items()}
        for index, parts in self.optimiser.state_dict()["state"].items():
            out |= {f"optimiser/{index}/{key}": torch.as_tensor(value).clone() for key, value in parts.items()}
        return out

    def load(self, state: State) -> None:
        """Go on from :meth:`state`.

        Raises:
            InputError: it is of another model; names the tensor.
        """
        for label in ("model", "best"):
            for key, value in _weights(self.learner.model).items():
                result = state.get(f"{label}/{key}")
                if result is None or result.shape != value.shape:
                    raise InputError("baseline state", f"{label}/{key}", "is missing or of another shape")
        self.learner.model.load_state_dict(_under(state, "model"))
        self.best = {key: value.clone() for key, value in _under(state, "best").items()}
        moments: dict[int, State] = {}
        for key, value in _under(state, "optimiser").items():
            index, name = key.split("/")
            moments.setdefault(int(index), {})[name] = value.clone()
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})
        self.result.steps, self.result.frames, self.since_best = (int(v) for v in state["counters"])
        self.result.held_out = float(state["held_out"])
        self.result.history = [(int(f), loss, error) for f, loss, error in state["history"].tolist()]

    def step(self, seed: int, total_frames: int) -> float:
        """One gradient step; its draws depend on ``seed`` and the step's number alone, so a resumed run is the same."""
        generator = torch.Generator().manual_seed(seed * 1_000_003 + self.result.steps)
        torch.manual_seed(seed * 1_000_003 + self.result.steps)  # dropout draws from torch's own
        progress = min(1.0, self.result.frames / total_frames)
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * progress))
        self.learner.model.train()
        loss, frames = self.learner.loss(generator, progress)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.learner.model.parameters(), self.settings.gradient_clip)
        if torch.isfinite(norm):  # a step on anything else would spoil every weight
            self.optimiser.step()
        self.result.steps += 1
        self.result.frames += frames
        return float(loss.detach())

    def look(self, loss: float) -> None:
        """Judge the weights on the held-out frames and keep them where they are the best; without any, the last."""
        self.learner.model.eval()
        error = self.learner.held_out()
        self.result.history.append((self.result.frames, loss, error))
        if math.isnan(error) or not error >= self.result.held_out:
            self.best, self.since_best = _weights(self.learner.model), 0
            self.result.held_out = error
        else:
            self.since_best += 1


def fit(
    learner: Learner,
    settings: FitSettings,
    seed: int,
    total_frames: int,
    max_seconds: float | None = None,
    save: Callable[[Fit], None] | None = None,
    resume: State | None = None,
    stop: threading.Event | None = None,
) -> FitResult:
    """Train ``learner.model`` in place; at the end it holds the best weights, in evaluation mode.

    Args:
        learner: model, loss and held-out error.
        settings: see :class:`FitSettings`.
        seed: of every draw.
        total_frames: of motion, counted as often as they are seen.
        max_seconds: of this process, None for no limit.
        save: called after each look and at the end.
        resume: of :meth:`Fit.state`.
        stop: ends training after a step once it is set.

    Raises:
        InputError: ``resume`` is of another model.
    """
    with torch_threads(settings.threads), torch.random.fork_rng(devices=[]):
        work = Fit(learner, settings)
        if resume is not None:
            work.load(resume)
        result, losses, begun = work.result, [], time.monotonic()
        while True:
            result.reason = _end(work, total_frames, max_seconds, time.monotonic() - begun, stop)
            if result.reason:
                break
            losses.append(work.step(seed, total_frames))
            if result.steps % settings.check_every == 0:
                work.look(sum(losses) / len(losses))
                losses = []
                if save is not None:
                    save(work)
        if losses and result.reason != "interrupted":
            work.look(sum(losses) / len(losses))
        if save is not None:
            save(work)
        learner.model.load_state_dict(work.best)
        learner.model.eval()
    return result


def _end(work: Fit, total_frames: int, max_seconds: float | None, seconds: float, stop: threading.Event | None) -> str:
    if stop is not None and stop.is_set():
        return "interrupted"
    if work.result.frames >= total_frames:
        return "total_steps"
    if work.since_best >= work.settings.patience:
        return "patience"
    if max_seconds is not None and seconds >= max_seconds:
        return "max_seconds"
    return ""


def _weights(model: nn.Module) -> State:
    return {key: value.detach().clone() for key, value in model.state_dict().items()}


def _under(state: Mapping[str, Tensor], label: str) -> State:
    return {key.removeprefix(f"{label}/"): value for key, value in state.items() if key.startswith(f"{label}/")}
