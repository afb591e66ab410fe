"""A training from its configuration to its last checkpoint: new, resumed, or a job of a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from egopose.checkpoint.resume import FINISHED, continued_job, finished, mark_finished, only_process, resumed_config
from egopose.core.errors import InputError
from egopose.pipeline.clip_start import teach_plan
from egopose.pipeline.dataset import absolute_paths, load_dataset, run_dataset
from egopose.pipeline.forecaster import with_forecasts
from egopose.pipeline.run import build_evaluation, build_run, start_from
from egopose.tasks.dataset import Dataset
from egopose.training.logging import build_loggers, write_provenance
from egopose.training.loop import TrainingStopped, train
from egopose.training.ppo import TrainingDiverged

#: What ends a run whose checkpoints are whole: it can be resumed.
STOPPING = (TrainingDiverged, TrainingStopped, OSError)


def run_training(
    config: dict[str, Any], folder: Path, checkpoint: Path | None = None, dataset: Dataset | None = None
) -> float:
    """Train in ``folder`` and say where things are.

    Args:
        config: resolved.
        folder: the run directory.
        checkpoint: to go on from, None for a new run.
        dataset: to train on; None for what ``config`` names.

    Returns:
        The score of the last evaluation (or the mean episode length in training).

    Raises:
        InputError: the configuration, the data or the checkpoint do not fit.
        TrainingDiverged, TrainingStopped: see :func:`egopose.training.loop.train`.
        SystemExit: 130 after Ctrl-C, so that a sweep stops as well.
    """
    # Another Ctrl-C than the loop's own, or one before it, ends in an exception: what is on the disk stays whole.
    try:
        write_provenance(folder, config)
        (folder / FINISHED).unlink(missing_ok=True)
        print(f"run directory: {folder}", flush=True)
        if dataset is None:
            dataset = load_dataset(config) if checkpoint is None else run_dataset(config, folder)
        dataset = with_forecasts(config, dataset, folder)
        run = build_run(config, folder, dataset)
        try:
            if checkpoint is not None:
                run.restore(checkpoint)
                print(f"resuming {folder} after iteration {run.counters.iteration}", flush=True)
            elif (other := config["training"].get("start_from")) is not None:
                start_from(run, str(other))
            elif (teaching := config["task"].get("cloning")) is not None:
                teach_plan(run, dataset, teaching)
            loggers = build_loggers(config["logger"], folder, config, run.counters.iteration, run.counters.frames)
            outcome = train(run, loggers, build_evaluation(run, dataset))
        finally:
            run.collector.shutdown()
    except KeyboardInterrupt:
        print(f"stopped at once; go on with: python -m egopose.train resume={folder}", flush=True)
        raise SystemExit(130) from None
    print(f"{outcome.reason}: {outcome.iteration} iterations, {outcome.frames} steps; saved {outcome.checkpoint}")
    if outcome.reason == "interrupted":
        print(f"go on with: python -m egopose.train resume={folder}", flush=True)
        raise SystemExit(130)
    figures = {"reason": outcome.reason, "iteration": outcome.iteration, "score": run.counters.score}
    mark_finished(folder, config, figures)
    return run.counters.score


def run_job(config: dict[str, Any], folder: Path, dataset: Dataset | None = None) -> float:
    """:func:`run_training` in the directory of one job of a sweep, as far as that is still to be done.

    A job that came to its end is not run again; one that was cut off goes on from its last checkpoint.

    Raises:
        InputError: as :func:`run_training`; the directory is that of another job.
    """
    checkpoint = continued_job(folder, config)
    if (done := finished(folder, config)) is not None:
        print(f"{folder}: {done['reason']} already after {done['iteration']} iterations", flush=True)
        return float(done["score"])
    return run_training(config, folder, checkpoint, dataset)


def start_run(config: dict[str, Any], folder: Path, multirun: bool, overrides: list[str]) -> float:
    """What ``egopose train`` does with one configuration: a new run, one resumed, or one of a sweep.

    Args:
        config: resolved; its ``resume`` names a run directory to go on with.
        folder: the run directory.
        multirun: it is a job of a sweep.
        overrides: as given on the command line.

    Returns:
        See :func:`run_training`.

    Raises:
        InputError: as :func:`run_training`; the directory holds a run already, or is another process's.
    """
    if config["resume"] is not None and multirun:
        raise InputError("resume", str(config["resume"]), "is for one run; give a sweep the same hydra.sweep.dir again")
    composed = absolute_paths(config)
    with only_process(folder):
        if multirun:
            return run_job(composed, folder)
        if config["resume"] is None:
            if (folder / "config.yaml").exists():
                raise InputError(folder, "run directory", f"holds a run; to go on with it: resume={folder}")
            return run_training(composed, folder)
        saved, checkpoint = resumed_config(folder, composed, overrides)
        return run_training(saved, folder, checkpoint)
