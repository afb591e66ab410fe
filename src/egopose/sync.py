"""``python -m egopose.sync video=x.mp4 motion=y.bvh [data.camera.field_of_view=118]``: their sync offset."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import sys  # noqa: E402
from collections.abc import Mapping  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from omegaconf import DictConfig  # noqa: E402

from egopose.config import command, resolved  # noqa: E402
from egopose.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    from egopose.data.sync import Sync


def run_sync(config: Mapping[str, Any]) -> Sync:
    """The way of ``conf/sync.yaml``, resolved.

    Raises:
        InputError: video, motion or a setting cannot be used, or no offset stands out; says what to do then.
    """
    from egopose.data.sync import settings_of, sync_offset
    from egopose.motion.io import given_options, read_motion
    from egopose.motion.notes import tell_notes
    from egopose.vision.flow import FlowConfig
    from egopose.vision.lens import Camera

    camera = Camera.from_mapping(config["data"]["camera"], "data.camera")
    motion = read_motion(str(config["motion"]), **given_options(config["reader"]))
    tell_notes(str(config["motion"]), motion, lambda line: print(line, file=sys.stderr))
    flow = FlowConfig(**config["vision"]["flow"])
    settings = settings_of(config["data"])
    return sync_offset(str(config["video"]), motion, settings, flow, camera, dict(config["mapping"]))


@command("sync")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    try:
        found = run_sync(resolved(config))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(
        f"sync_offset: {found.offset:.3f}   # s; correlation {found.correlation:.2f}, confidence {found.confidence:.2f}"
    )
    if found.offset < 0:
        print(f"The motion begins {-found.offset:.3f} s before the video: cut that much off its beginning.")


if __name__ == "__main__":
    main()
