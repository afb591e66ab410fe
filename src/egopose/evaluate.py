"""``python -m egopose.evaluate checkpoint=RUN_OR_CHECKPOINT [split=test] [out=DIR]``: score a policy beside PoseReg."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError


@command("evaluate")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.evaluation.run import evaluate

    try:
        print(evaluate(resolved(config)), flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
