"""The training loop: collect, estimate advantages, update, log, save; stops at a budget or at Ctrl-C and resumes."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.checkpoint import GlobalRNGState

from egopose.checkpoint import checkpoint as checkpoints
from egopose.collection import collectors
from egopose.collection.collectors import CollectorSettings
from egopose.collection.workers import WorkerLost
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.tasks.task import task_name
from egopose.training.logging import ProgressLine, Scalars
from egopose.training.ppo import PPO, TrainingDiverged

Evaluation = Callable[[int], Mapping[str, float]]


class TrainingStopped(RuntimeError):
    """Something outside the run ended it: a full disk, a process that was killed. Its checkpoints are whole."""


@dataclass(frozen=True)
class LoopSettings:
    """How long, and what is kept; see ``conf/train.yaml`` (``training``) and ``conf/algo``.

    Args:
        iterations: of collection and update.
        steps_per_iteration: control steps over all worlds.
        critic_first: iterations in which the critic alone learns, for a policy that was taught before.
        total_steps: stop at this many control steps, None for no limit besides ``iterations``.
        max_seconds: stop before the iteration that would end later than this, counted from the start of this process's
            training; None for no limit.
        checkpoint_every: iterations.
        keep_last: checkpoints kept besides the best.
        evaluate_every: iterations; 0 for never.
    """

    iterations: int
    steps_per_iteration: int
    critic_first: int
    total_steps: int | None
    max_seconds: float | None
    checkpoint_every: int
    keep_last: int
    evaluate_every: int

    @classmethod
    def from_config(cls, values: Mapping[str, Any], source: str = "conf/train.yaml") -> LoopSettings:
        """Raises InputError: a key is missing, unknown or out of range."""
        settings = from_mapping(cls, values, source)
        # Two checkpoints: where the last one is damaged, there must be one before it.
        for name, least in (("iterations", 1), ("steps_per_iteration", 1), ("checkpoint_every", 1), ("keep_last", 2)):
            if getattr(settings, name) < least:
                raise InputError(source, name, f"must be at least {least}, not {getattr(settings, name)}")
        for name in ("total_steps", "max_seconds"):
            value = getattr(settings, name)
            # No step at all: a run that takes over another's policy as it is (training.start_from).
            if value is not None and not (value > 0 or (name == "total_steps" and value == 0)):
                raise InputError(source, name, f"must be positive or null, not {value}")
        return settings


@dataclass
class Counters:
    """Where a run stands; a component of its checkpoints (``trainer_state``).

    Args:
        score: of the last evaluation.
        scored: whether no checkpoint has been written since: the next one is the one it belongs to.
    """

    iteration: int = 0
    frames: int = 0
    seconds: float = 0.0
    skipped_minibatches: int = 0
    diverged_worlds: int = 0
    score: float = 0.0
    scored: bool = False


@dataclass(frozen=True)
class Outcome:
    """How training ended: ``reason`` is ``finished``, ``total_steps``, ``max_seconds`` or ``interrupted``."""

    reason: str
    iteration: int
    frames: int
    checkpoint: Path


@dataclass
class Run:
    """All that a run is made of, and what of it goes into a checkpoint.

    Args:
        ppo: the learner.
        collector: from :func:`egopose.collection.collectors.build_collector`.
        settings: see :class:`LoopSettings`.
        collector_settings: threads.
        folder: the run directory.
        config: resolved, as plain containers; its task is :attr:`task`.
        action_size: of the environment.
    """

    ppo: PPO
    collector: Any
    settings: LoopSettings
    collector_settings: CollectorSettings
    folder: Path
    config: Mapping[str, Any]
    action_size: int
    counters: Counters = field(default_factory=Counters)
    _saved: tuple[int, Path] | None = None

    @property
    def task(self) -> str:
        return task_name(self.config)

    def checkpoint(self) -> checkpoints.RunCheckpoint:
        """The components bound to this run's live objects."""
        return checkpoints.RunCheckpoint(
            {
                **self.ppo.state(),
                "transforms": _TransformState(self.collector),
                "simulation": checkpoints.ComponentState(
                    lambda: collectors.simulation_state(self.collector),
                    lambda state: collectors.load_simulation_state(self.collector, state),
                ),
                "rng": checkpoints.ComponentState(GlobalRNGState().state_dict, GlobalRNGState().load_state_dict),
                "trainer_state": vars(self.counters),
                "config": dict(self.config),
            }
        )

    def save(self) -> Path:
        """Write a checkpoint named after the control steps so far, and drop those no longer kept.

        Where this run directory's checkpoint of these steps was written or restored by this very run, it stays.

        Raises:
            TrainingDiverged: a weight or a statistic is not finite; nothing is written.
            SaveFailed: see :meth:`RunCheckpoint.save`.
        """
        state = self.counters
        if self._saved is not None and self._saved[0] == state.frames and self._saved[1].is_dir():
            return self._saved[1]
        score = state.score if state.scored else checkpoints.NOT_JUDGED
        state.scored = False
        components = self.checkpoint()
        for name in ("policy", "critic", "policy_optimizer", "value_optimizer", "transforms"):
            if (result := _not_finite(components.components[name].state_dict(), name)) is not None:
                raise TrainingDiverged(f"{result} is not finite")
        metadata = checkpoints.metadata_of(self.task, self.action_size, state.iteration, state.frames, score)
        kept = checkpoints.rotation(self.folder, self.settings.keep_last)
        self._saved = state.frames, kept.save(components, step=state.frames, metadata=metadata)
        return self._saved[1]

    def restore(self, path: str | Path) -> None:
        """Take over everything from a checkpoint of a run with the same configuration.

        Raises:
            InputError: it is damaged, of another task, or does not fit; names the field.
        """
        metadata = checkpoints.verify(path)
        checkpoints.require(metadata, path, task=self.task, action_size=self.action_size)
        restored = self.checkpoint()
        names = set(restored.components)
        # The random generators last: loading the rest may draw from them.
        restored.restore(path, names - {"rng", "config", "trainer_state"})
        self.counters = Counters(**checkpoints.read_json(path, "trainer_state"))
        restored.restore(path, {"rng"})
        self.collector.update_policy_weights_()
        if Path(path).resolve().parent == (self.folder / checkpoints.FOLDER).resolve():
            self._saved = self.counters.frames, Path(path)


class _TransformState:
    """The environment's transforms as a component with a ``state_dict``."""

    def __init__(self, collector: Any) -> None:
        self.collector = collector

    def state_dict(self) -> Mapping[str, Any]:
        return collectors.transform_state(self.collector)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        collectors.load_transform_state(self.collector, state)


def train(run: Run, loggers: Sequence[Scalars], evaluate: Evaluation | None = None) -> Outcome:
    """Train until a budget is used up or a stop is asked for; always leaves a checkpoint of the last whole iteration.

    Args:
        run: fresh, or restored from a checkpoint.
        loggers: get every iteration's figures.
        evaluate: called every ``evaluate_every`` iterations with the iteration's number; its figures are logged under
            ``evaluation/``, and its ``score``, if it gives one, decides which checkpoint is the best (otherwise the
            mean episode length in training does); what was judged is saved at once.

    Raises:
        TrainingDiverged: see :meth:`PPO.update` and :meth:`Run.save`.
        TrainingStopped: the disk is full, or a process of the collector is gone.

    In either case the checkpoints written before are whole, and the message names the last one.
    """
    settings, counters = run.settings, run.counters
    progress = ProgressLine(settings.iterations, counters.iteration, settings.max_seconds)
    begin = time.monotonic()
    slowest = 0.0
    batches = iter(run.collector)
    with stop_signals() as stop:
        try:
            while (reason := _end(settings, counters, time.monotonic() - begin + slowest, stop)) is None:
                started = time.monotonic()
                figures = iterate(run, batches)
                judged = _judge(run, figures, evaluate)
                figures |= judged
                for logger in loggers:
                    logger.write(counters.frames, figures)
                progress.update(counters.iteration, figures)
                if judged or counters.iteration % settings.checkpoint_every == 0:
                    run.save()
                slowest = max(slowest, time.monotonic() - started)
                counters.seconds += time.monotonic() - started
            return Outcome(reason, counters.iteration, counters.frames, run.save())
        except TrainingDiverged as error:
            # Nothing of it is saved: some of this iteration's gradient steps may have been the ones that led here.
            raise TrainingDiverged(f"{error}; {_what_is_kept(run)}") from error
        except WorkerLost as error:
            # It is missed before anything of the iteration was learned: the one before is whole.
            run.save()
            raise TrainingStopped(f"{error}; {_what_is_kept(run)}") from error
        except (OSError, checkpoints.SaveFailed) as error:
            raise TrainingStopped(f"{error}; {_what_is_kept(run)}") from error
        finally:
            progress.close()
            for logger in loggers:
                with suppress(OSError):  # on a full disk: what stopped the run is told already
                    logger.close()


def _what_is_kept(run: Run) -> str:
    """What a run that cannot go on leaves behind."""
    try:
        return f"the last checkpoint is {checkpoints.find_checkpoint(run.folder)}"
    except InputError:
        return "no checkpoint had been written yet"


def _not_finite(state: Any, name: str) -> str | None:
    """The dotted name of the first tensor with a value that is not finite, or None."""
    if isinstance(state, torch.Tensor):
        return None if torch.isfinite(state).all() else name
    if isinstance(state, Mapping):
        for key, value in state.items():
            if (result := _not_finite(value, f"{name}.{key}")) is not None:
                return result
    return None


def _judge(run: Run, figures: Mapping[str, float], evaluate: Evaluation | None) -> dict[str, float]:
    """Evaluate where it is due; keeps the score of the last evaluation, or of training where there is none."""
    counters, every = run.counters, run.settings.evaluate_every
    if evaluate is None or every == 0:
        counters.score, counters.scored = figures.get("episode_length", counters.score), True
        return {}
    if counters.iteration % every != 0:
        return {}
    # An evaluation draws (and TorchRL seeds) random numbers; training's own must not notice.
    with torch.random.fork_rng(devices=[]):
        result = dict(evaluate(counters.iteration))
    if "score" in result:
        counters.score, counters.scored = result["score"], True
    return {f"evaluation/{name}": value for name, value in result.items()}


def iterate(run: Run, batches: Iterator[TensorDictBase]) -> dict[str, float]:
    """One iteration; returns its figures and moves the counters."""
    threads, counters = run.collector_settings, run.counters
    clock = [time.monotonic()]
    collectors.set_threads(threads.threads)
    # Watched one by one: TorchRL takes an error in the first for a late answer and goes on.
    with worker_watch(run.collector):
        run.collector.update_policy_weights_()
    with worker_watch(run.collector):
        batch = next(batches)
    clock.append(time.monotonic())
    collectors.set_threads(threads.update_threads)
    rows = run.ppo.advantages(batch)
    clock.append(time.monotonic())
    run.ppo.policy_held = counters.iteration < run.settings.critic_first
    try:
        learning = run.ppo.update(rows)
    finally:
        collectors.set_threads(threads.threads)
    clock.append(time.monotonic())

    counters.iteration += 1
    counters.frames += batch.numel()
    counters.skipped_minibatches += int(learning["skipped_minibatches"])
    experience = batch_metrics(batch)
    counters.diverged_worlds += int(experience.get("diverged", 0))
    return {
        "iteration": float(counters.iteration),
        **experience,
        **learning,
        "steps_per_s": batch.numel() / (clock[3] - clock[0]),
        "seconds_collect": clock[1] - clock[0],
        "seconds_gae": clock[2] - clock[1],
        "seconds_update": clock[3] - clock[2],
    }


def batch_metrics(batch: TensorDictBase) -> dict[str, float]:
    """Figures of a batch ``[N, T]``.

    ``reward`` and each of ``reward_terms``: mean a step. Of the episodes that ended in the batch: ``episode_length``
    (frames survived, mean), ``falls`` (the fraction that ended before the time limit), ``episodes`` (how many).
    ``diverged``: worlds whose physics broke.
    """
    after = batch["next"]
    names = set(after.keys())
    out = {"reward": float(after["reward"].mean())}
    if "reward_terms" in names:
        out |= {f"reward_{name}": float(term.mean()) for name, term in sorted(after["reward_terms"].items())}
    ended = after["done"].squeeze(-1)
    out["episodes"] = float(ended.sum())
    if ended.any():
        out["falls"] = float(after["terminated"].squeeze(-1)[ended].float().mean())
        if "episode_step" in names:
            out["episode_length"] = float(after["episode_step"].squeeze(-1)[ended].float().mean())
    if "diverged" in names:
        out["diverged"] = float(after["diverged"].sum())
    return out


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets; a second one interrupts at once. Plain event outside the main thread."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()
        print("\nstopping after this iteration; once more to stop at once", flush=True)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Ctrl-C waits until the end; processes started meanwhile never get it.

    A terminal sends it to all processes at once, and workers that stop at it would take their iteration with them.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # its start would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def worker_watch(collector: Any) -> Iterator[None]:
    """Where one of the collector's processes ends, raises :class:`WorkerLost` instead of waiting for it for ever."""
    workers = getattr(getattr(collector, "_collector", collector), "procs", ())
    if not workers or not hasattr(signal, "SIGCHLD") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def look(number: int = 0, frame: FrameType | None = None) -> None:
        # TorchRL ends all of them when it misses one.
        if codes := [str(worker.exitcode) for worker in workers if not worker.is_alive()]:
            raise WorkerLost(f"worker processes ended, exit codes {', '.join(codes)} (-9: killed, often for memory)")

    before = signal.signal(signal.SIGCHLD, look)
    try:
        look()
        yield
    except (OSError, EOFError, RuntimeError):
        look()  # the end of a worker may show first in its pipe
        raise
    finally:
        signal.signal(signal.SIGCHLD, before)


def _end(settings: LoopSettings, counters: Counters, seconds_after_next: float, stop: threading.Event) -> str | None:
    """Why no further iteration is begun, or None."""
    if stop.is_set():
        return "interrupted"
    if counters.iteration >= settings.iterations:
        return "finished"
    if settings.total_steps is not None and counters.frames >= settings.total_steps:
        return "total_steps"
    if settings.max_seconds is not None and seconds_after_next > settings.max_seconds:
        return "max_seconds"
    return None
