"""``python -m egopose.train [group=choice] [key=value] [resume=RUN_DIR] [--multirun]``: train a policy.

With ``--config-name body_parts`` it trains what finds the wearer's body parts in a picture (docs/howto-body-parts.md),
with ``--config-name head_signal`` what reads states from a camera's motion (docs/howto-estimate.md), with
``--config-name contacts`` what tells which foot touches something, with ``--config-name lifter`` what lifts 2D
keypoints (docs/howto-lift.md), and with ``--config-name tracker`` a policy that follows any motion, before PPO goes on.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from egopose.core.config import check_arguments, faults_told, register_resolvers, resolved
from egopose.core.config_files import config_dir
from egopose.core.errors import InputError
from egopose.core.path_settings import check_paths, check_run_directory

register_resolvers()


@hydra.main(version_base="1.3", config_path=str(config_dir()), config_name="train")
def hydra_main(config: DictConfig) -> float:
    """One job of Hydra's: a new run, one resumed, or one of a sweep."""
    state = HydraConfig.get()
    # Not after the imports, which take seconds.
    with faults_told("train"):
        check_paths(str(state.job.config_name), config)

    from egopose.pipeline.body_parts import train_body_parts
    from egopose.pipeline.contacts import train_contacts
    from egopose.pipeline.head_signal import train_head_signal
    from egopose.pipeline.lifting import train_lifter
    from egopose.pipeline.tracker import train_tracker
    from egopose.pipeline.training import STOPPING, start_run

    # MuJoCo warns here of every world that diverges; they are counted, and their last states kept.
    logging.getLogger("absl").setLevel(logging.ERROR)
    try:
        others = {"body_parts": train_body_parts, "head_signal": train_head_signal}
        others |= {"contacts": train_contacts, "lifter": train_lifter, "tracker": train_tracker}
        if state.job.config_name in others:
            others[state.job.config_name](resolved(config))
            return 0.0
        folder = Path(state.runtime.output_dir if config.resume is None else config.resume).resolve()
        return start_run(resolved(config), folder, state.mode == RunMode.MULTIRUN, list(state.overrides.task))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except STOPPING as error:
        print(f"error: {error}\ngo on with: python -m egopose.train resume={folder}", file=sys.stderr)
        raise SystemExit(1) from None


def main() -> None:
    """The command. A run directory that is not there is refused before Hydra would make it."""
    with faults_told("train"):
        check_arguments(sys.argv[1:])
        check_run_directory(sys.argv[1:])
        hydra_main()


if __name__ == "__main__":
    main()
