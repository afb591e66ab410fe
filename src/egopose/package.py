"""``python -m egopose.package run=RUN name=NAME``: a trained run as a small folder that can be given away."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError


@command("package")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.checkpoint.package import package_run
    from egopose.evaluation.package_figures import describe_run

    try:
        out = package_run(resolved(config), describe_run)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    print(f"{out}: {size / 1e6:.2f} MB", flush=True)


if __name__ == "__main__":
    main()
