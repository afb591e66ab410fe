"""``python -m egopose.estimate video=x.mp4 checkpoint=RUN_OR_CHECKPOINT [out=DIR]``: motion from a video alone."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError
from egopose.core.runtime import libraries_loading


@command("estimate")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.inference.film_process import foreseen_film

    try:
        values = resolved(config)
        # Another process reads the film while this one imports torch and what stands on it.
        film = foreseen_film(values)

        with libraries_loading():
            from egopose.inference.video import estimate_video

        estimate_video(values, film)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
