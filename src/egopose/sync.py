"""``python -m egopose.sync video=x.mp4 motion=y.bvh [data.camera.field_of_view=118]``: their sync offset."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError


@command("sync")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.data.sync_offset import run_sync

    try:
        result = run_sync(resolved(config))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(
        f"sync_offset: {result.offset:.3f}   # s; correlation {result.correlation:.2f}, "
        f"confidence {result.confidence:.2f}"
    )
    if result.offset < 0:
        print(f"The motion begins {-result.offset:.3f} s before the video: cut that much off its beginning.")


if __name__ == "__main__":
    main()
