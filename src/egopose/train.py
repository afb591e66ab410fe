"""``python -m egopose.train [group=choice] [key=value] [resume=RUN_DIR] [--multirun]``: train a policy."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from egopose.core.config import check_arguments, config_dir, faults_told, register_resolvers, resolved
from egopose.core.errors import InputError

if TYPE_CHECKING:
    pass
from egopose.pipeline.training import run_job, run_training

register_resolvers()


@hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="train")
def hydra_main(config: DictConfig) -> float:
    """One job of Hydra's: a new run, one resumed, or one of a sweep."""
    from egopose.checkpoint.resume import only_process, resumed_config
    from egopose.pipeline.dataset import absolute_paths
    from egopose.training.loop import TrainingStopped
    from egopose.training.ppo import TrainingDiverged

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
