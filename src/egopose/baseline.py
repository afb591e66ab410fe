"""``python -m egopose.baseline baseline=NAME [resume=RUN_DIR] [key=value]``: train a method to compare with."""

from __future__ import annotations

import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from egopose.core.config import command, register_resolvers, resolved
from egopose.core.errors import InputError

register_resolvers()


@command("baseline")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.checkpoint.resume import only_process, resumed_config
    from egopose.pipeline.baselines import run_baseline_job
    from egopose.pipeline.dataset import absolute_paths

    state = HydraConfig.get()
    folder = Path(state.runtime.output_dir if config.resume is None else config.resume).resolve()
    try:
        composed = absolute_paths(resolved(config))
        with only_process(folder):
            if config.resume is not None:
                composed, _ = resumed_config(folder, composed, list(state.overrides.task))
            elif (folder / "config.yaml").exists():
                raise InputError(folder, "run directory", f"holds a run; to go on with it: resume={folder}")
            run_baseline_job(composed, folder)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
