"""What an estimate leaves behind: motions as BVH and npz, a side-by-side video, and where its footage lies."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from egopose.core.result_files import write_json
from egopose.humanoid.model import HumanoidModel
from egopose.motion.io import write_motion
from egopose.motion.motion import Motion
from egopose.vision.side_by_side import side_by_side
from egopose.vision.video import iter_frames, write_video

FOOTAGE = "wearer.json"
RENDERED_NOTE = "The wearer's video was rendered from real motion capture, not filmed."


@dataclass(frozen=True)
class TakeVideo:
    """The wearer's video of a take: the motion's time t is the video's ``t + sync_offset`` seconds.

    ``taken_at`` is the rate of filming where the file's stamps are not of it, see
    :func:`egopose.vision.video.read_frames`.
    """

    path: Path
    sync_offset: float
    rendered: bool
    taken_at: float | None = None

    @property
    def label(self) -> str:
        """Says in the picture where it comes from."""
        return "wearer's view (rendered)" if self.rendered else "wearer's view"


def write_footage(folder: Path, video: TakeVideo, start: int, fps: float) -> None:
    """``wearer.json``: where the wearer's video of what lies in ``folder`` is, and how it fits.

    Args:
        folder: of a take or a window.
        video: of the take.
        start: frame of the take that the folder's motions begin at. fps: of the motions.
    """
    result = {
        "video": str(video.path.resolve()),
        "sync_offset": video.sync_offset,
        "start": start / fps,
        "taken_at": video.taken_at,
        "rendered": video.rendered,
    }
    write_json(folder / FOOTAGE, result)


def write_motion_files(folder: Path, name: str, motion: Motion) -> None:
    """``NAME.bvh`` for other programs, ``NAME.npz`` for this one."""
    write_motion(motion, folder / f"{name}.bvh")
    write_motion(motion, folder / f"{name}.npz")


def write_side_by_side(
    path: Path, humanoid: HumanoidModel, motions: Mapping[str, Motion], video: TakeVideo, start: int, size: int
) -> None:
    """The motions from beside and the wearer's view, in step.

    Args:
        path: the MP4.
        humanoid: whose model is drawn.
        motions: label -> motion, all of one length.
        video: of the take the motions lie in.
        start: frame of the take the motions begin at.
        size: pixels a panel.

    Raises:
        InputError: the video cannot be read or ends before the motions.
        RuntimeError: no OpenGL here.
    """
    first = next(iter(motions.values()))
    seen = iter_frames(video.path, first.fps, video.sync_offset + start / first.fps, len(first), video.taken_at)
    bodies = {label: motion.qpos for label, motion in motions.items()}
    write_video(path, side_by_side(humanoid.mj_model, bodies, seen, video.label, size), first.fps)


def file_name(name: str) -> str:
    """A take's name as a folder's: letters, digits, dot, dash and underscore stay."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "take"
