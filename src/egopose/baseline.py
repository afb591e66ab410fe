"""``python -m egopose.baseline baseline=NAME [resume=RUN_DIR] [key=value]``: train a method to compare with."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from egopose.core.config import command, register_resolvers, resolved
from egopose.core.errors import InputError

register_resolvers()


def run_baseline_job(config: dict[str, Any], folder: Path) -> None:
    """Train in ``folder`` as far as that is still to be done: from its last checkpoint, or not at all.

    Raises:
        InputError: as :func:`egopose.pipeline.baselines.run_baseline`; the directory is that of another job.
    """
    from egopose.checkpoint.resume import continued_job, finished
    from egopose.pipeline.baselines import run_baseline
    from egopose.training.logging import write_provenance

    checkpoint = continued_job(folder, config)
    if (done := finished(folder, config)) is not None:
        print(f"{folder}: {done['reason']} already after {done['iteration']} steps", flush=True)
        return
    write_provenance(folder, config)
    print(f"run directory: {folder}", flush=True)
    result = run_baseline(config, folder, checkpoint)
    print(
        f"{result.reason}: {result.steps} steps, {result.frames} frames, held-out error {result.held_out:.4f}",
        flush=True,
    )
    if result.reason == "interrupted":
        print(f"go on with: python -m egopose.baseline resume={folder}", flush=True)
        raise SystemExit(130)


@command("baseline")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.checkpoint.resume import only_process, resumed_config
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
