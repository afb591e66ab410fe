"""``python -m egopose.train [group=choice] [key=value] [resume=RUN_DIR] [--multirun]``: train a policy."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import logging  # noqa: E402
import sys  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from contextlib import contextmanager  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

import hydra  # noqa: E402
from hydra.core.hydra_config import HydraConfig  # noqa: E402
from hydra.types import RunMode  # noqa: E402
from omegaconf import DictConfig  # noqa: E402

from egopose.config import check_arguments, config_dir, faults_told, register_resolvers, resolved  # noqa: E402
from egopose.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    from egopose.material import Material
    from egopose.training.loop import BackgroundEvaluation, Evaluation, Run

register_resolvers()


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
    from egopose import pipeline
    from egopose.motion_forecasts import with_futures
    from egopose.training.logging import build_loggers, write_provenance
    from egopose.training.loop import train
    from egopose.training.resume import FINISHED, mark_finished

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
        from egopose.pipeline import build_evaluation

        yield build_evaluation(run, material)
        return
    from egopose.evaluators import BackgroundSurvival

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
    from egopose.training.resume import continued_job, finished

    checkpoint = continued_job(folder, config)
    if (done := finished(folder, config)) is not None:
        print(f"{folder}: {done['reason']} already after {done['iteration']} iterations", flush=True)
        return float(done["score"])
    return run_training(config, folder, checkpoint, material)


@hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="train")
def hydra_main(config: DictConfig) -> float:
    """One job of Hydra's: a new run, one resumed, or one of a sweep."""
    from egopose.material import absolute_paths
    from egopose.training.loop import TrainingStopped
    from egopose.training.ppo import TrainingDiverged
    from egopose.training.resume import only_process, resumed_config

    state = HydraConfig.get()
    # MuJoCo warns here of every world that diverges; they are counted, and their last states kept.
    logging.getLogger("absl").setLevel(logging.ERROR)
    folder = Path(state.runtime.output_dir if config.resume is None else config.resume).resolve()
    try:
        if config.resume is not None and state.mode == RunMode.MULTIRUN:
            raise InputError(
                "resume", str(config.resume), "is for one run; give a sweep the same hydra.sweep.dir again"
            )
        composed = absolute_paths(resolved(config))
        with only_process(folder):
            if state.mode == RunMode.MULTIRUN:
                return run_job(composed, folder)
            if config.resume is None:
                if (folder / "config.yaml").exists():
                    raise InputError(folder, "run directory", f"holds a run; to go on with it: resume={folder}")
                return run_training(composed, folder)
            saved, checkpoint = resumed_config(folder, composed, list(state.overrides.task))
            return run_training(saved, folder, checkpoint)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except (TrainingDiverged, TrainingStopped, OSError) as error:
        print(f"error: {error}\ngo on with: python -m egopose.train resume={folder}", file=sys.stderr)
        raise SystemExit(1) from None


def main() -> None:
    """The command. A run directory that is not there is refused before Hydra would make it."""
    with faults_told("train"):
        check_arguments(sys.argv[1:])
    for word in sys.argv[1:]:
        name, _, value = word.partition("=")
        if name != "resume" or value in ("", "null"):
            continue
        if not Path(value).is_dir():
            print(f"error: {value}: run directory: does not exist", file=sys.stderr)
            raise SystemExit(2)
        if not (Path(value) / "config.yaml").is_file() and not (Path(value) / "checkpoints").is_dir():
            print(f"error: {value}: config.yaml: is missing: this is no run directory", file=sys.stderr)
            raise SystemExit(2)
    with faults_told("train"):
        hydra_main()


if __name__ == "__main__":
    main()
