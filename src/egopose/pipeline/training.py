"""``python -m egopose.train [group=choice] [key=value] [resume=RUN_DIR] [--multirun]``: train a policy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from egopose import pipeline
from egopose.checkpoint.resume import FINISHED, continued_job, finished, mark_finished
from egopose.evaluation.torchrl_evaluator import BackgroundSurvival
from egopose.pipeline.forecaster import with_futures
from egopose.pipeline.run import build_evaluation
from egopose.tasks.dataset import Material
from egopose.training.logging import build_loggers, write_provenance
from egopose.training.loop import BackgroundEvaluation, Evaluation, Run, train


def run_training(
    config: dict[str, Any], folder: Path, checkpoint: Path | None = None, material: Material | None = None
) -> float:
    """Train in ``folder`` and say where things are.

    Args:
        config: resolved.
        folder: the run directory.
        checkpoint: to go on from, None for a new run.
        material: to train on; None for what ``config`` names.

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
        if material is None:
            material = pipeline.load_material(config) if checkpoint is None else pipeline.run_material(config, folder)
        material = with_futures(config, material, folder)
        run = pipeline.build_run(config, folder, material)
        try:
            if checkpoint is not None:
                run.restore(checkpoint)
                print(f"resuming {folder} after iteration {run.counters.iteration}", flush=True)
            loggers = build_loggers(config["logger"], folder, config, run.counters.iteration, run.counters.frames)
            with _evaluation(run, material) as evaluation:
                outcome = train(run, loggers, evaluation)
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


@contextmanager
def _evaluation(run: Run, material: Material) -> Iterator[Evaluation | BackgroundEvaluation]:
    """As ``training.evaluate_async`` says: between iterations, or beside them."""
    if not run.config["training"].get("evaluate_async") or not run.settings.evaluate_every:
        yield build_evaluation(run, material)
        return

    background = BackgroundSurvival(run, material)
    try:
        yield background
    finally:
        background.close()


def run_job(config: dict[str, Any], folder: Path, material: Material | None = None) -> float:
    """:func:`run_training` in the directory of one job of a sweep, as far as that is still to be done.

    A job that came to its end is not run again; one that was cut off goes on from its last checkpoint.

    Raises:
        InputError: as :func:`run_training`; the directory is that of another job.
    """

    checkpoint = continued_job(folder, config)
    if (done := finished(folder, config)) is not None:
        print(f"{folder}: {done['reason']} already after {done['iteration']} iterations", flush=True)
        return float(done["score"])
    return run_training(config, folder, checkpoint, material)
