"""``python -m egopose.train [group=choice] [key=value] [resume=RUN_DIR] [--multirun]``: train a policy."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import logging  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import hydra  # noqa: E402
from hydra.core.hydra_config import HydraConfig  # noqa: E402
from hydra.types import RunMode  # noqa: E402
from omegaconf import DictConfig  # noqa: E402

from egopose.config import config_dir, register_resolvers, resolved  # noqa: E402
from egopose.errors import InputError  # noqa: E402

register_resolvers()


def run_training(config: dict[str, Any], folder: Path, checkpoint: Path | None = None) -> float:
    """Train in ``folder`` and say where things are.

    Args:
        config: resolved.
        folder: the run directory.
        checkpoint: to go on from, None for a new run.

    Returns:
        The score of the last evaluation (or the mean episode length in training).

    Raises:
        InputError: the configuration, the data or the checkpoint do not fit.
        SystemExit: 130 after Ctrl-C, so that a sweep stops as well.
    """
    from egopose import pipeline
    from egopose.training.logging import build_loggers, write_provenance
    from egopose.training.loop import train

    write_provenance(folder, config)
    material = pipeline.load_material(config) if checkpoint is None else pipeline.run_material(config, folder)
    run = pipeline.build_run(config, folder, material)
    if checkpoint is not None:
        run.restore(checkpoint)
        print(f"resuming {folder} after iteration {run.counters.iteration}", flush=True)
    else:
        print(f"run directory: {folder}", flush=True)
    loggers = build_loggers(config["logger"], folder, config, run.counters.iteration, run.counters.frames)
    try:
        outcome = train(run, loggers, pipeline.build_evaluation(run, material))
    finally:
        run.collector.shutdown()
    print(f"{outcome.reason}: {outcome.iteration} iterations, {outcome.frames} steps; saved {outcome.checkpoint}")
    if outcome.reason == "interrupted":
        print(f"go on with: python -m egopose.train resume={folder}", flush=True)
        raise SystemExit(130)
    return run.counters.score


@hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="train")
def hydra_main(config: DictConfig) -> float:
    """One job of Hydra's: a new run, or one resumed."""
    from egopose.material import absolute_paths
    from egopose.training.resume import resumed_config

    state = HydraConfig.get()
    # MuJoCo warns here of every world that diverges; they are counted, and their last states kept.
    logging.getLogger("absl").setLevel(logging.ERROR)
    try:
        if config.resume is None:
            return run_training(absolute_paths(resolved(config)), Path(state.runtime.output_dir).resolve())
        if state.mode == RunMode.MULTIRUN:
            raise InputError("resume", str(config.resume), "resume one run at a time, without --multirun")
        folder = Path(config.resume).resolve()
        saved, checkpoint = resumed_config(folder, absolute_paths(resolved(config)), list(state.overrides.task))
        return run_training(saved, folder, checkpoint)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def main() -> None:
    """The command. A run directory that is not there is refused before Hydra would make it."""
    from egopose.training.checkpoint import find_checkpoint

    try:
        for word in sys.argv[1:]:
            if word.startswith("resume=") and word not in ("resume=", "resume=null"):
                find_checkpoint(word.removeprefix("resume="))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    hydra_main()


if __name__ == "__main__":
    main()
