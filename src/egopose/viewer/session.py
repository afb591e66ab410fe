"""From the words of a command to a viewer that serves: of files, or of a live stream."""

from __future__ import annotations

import secrets
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.path_settings import Kind, checked_path
from egopose.inference.reconstruction import reconstruction_folder, simulated_humanoid
from egopose.motion.io import given_options
from egopose.motion.notes import tell_notes
from egopose.motion.plausibility import source_findings, tell
from egopose.viewer.app import Viewer
from egopose.viewer.auth_proxy import Address
from egopose.viewer.clip import Footage
from egopose.viewer.clip_sources import read_runs
from egopose.viewer.live import LiveViewer
from egopose.viewer.reconstruction_app import ReconstructionViewer
from egopose.viewer.scene_app import SceneViewer, is_scene_folder
from egopose.viewer.timeline import TimelineViewer
from egopose.vision.video import probe_video

_LIVE = ("ws://", "wss://")


def is_source(word: str) -> bool:
    """Whether a word of the command names a stream or a file, and no setting."""
    return word.startswith(_LIVE) or Path(word).exists()


def open_viewer(
    words: Sequence[str],
    video: Path | None,
    offset: float | None,
    address: str,
    port: int,
    token: str | None,
    scene: bool = False,
    simulated: Path | None = None,
) -> TimelineViewer | LiveViewer:
    """A viewer that serves from now on.

    Args:
        words: sources, and overrides ``key=value`` of ``conf/sync.yaml``.
        video: the wearer's MP4, of a source that is one motion.
        offset: s, the motion's time 0 in the video; None to find it.
        address, port: to listen at.
        token: who may look; ``new`` makes one.
        scene: of a reconstruction, show the scene to be changed and not what came of it.
        simulated: of a reconstruction, another simulated motion of the clip than ``plan.npz``.

    Raises:
        InputError: viser is not installed, or a source cannot be shown.
    """
    if find_spec("viser") is None:
        raise InputError("view", "viser", "is not installed; pip install 'egopose[view]'")

    overrides = [word for word in words if "=" in word and not is_source(word)]
    sources = [word for word in words if word not in overrides]
    if not sources:
        raise InputError("view", "source", "none is named: a motion file, an evaluation, a run or ws:// address")
    place = Address(address, port, secrets.token_hex(16) if token == "new" else token)
    if sources[0].startswith(_LIVE):
        if len(sources) > 1:
            raise InputError("view", "source", "a live stream is shown by itself; name nothing beside it")
        return LiveViewer(sources[0], place)
    sources = [str(checked_path(source, Kind.EXISTING, "source")) for source in sources]
    video = None if video is None else Path(checked_path(str(video), Kind.FILE, "video"))
    simulated = None if simulated is None else Path(checked_path(str(simulated), Kind.FILE, "simulated"))
    made = None if scene else reconstruction_folder(Path(sources[0]), simulated)
    if made is not None or is_scene_folder(Path(sources[0])):
        if len(sources) > 1:
            raise InputError("view", "source", "a scene is shown by itself; name nothing beside it")
        if made is not None:
            return ReconstructionViewer(made, simulated_humanoid(), place, video, simulated)
        return SceneViewer(Path(sources[0]), place, video)
    footage = None if video is None else Footage(video, offset or 0.0)
    if footage is not None:
        probe_video(footage.path)
    reader = compose_config("sync", ["video=-", "motion=-", *overrides])["reader"]
    runs = read_runs(sources, footage, given_options(reader))
    for source, run in zip(sources, runs, strict=True):
        for name, clip in run.clips.items():
            if Path(source).is_file():
                tell(source_findings(clip.motion), name, lambda line: print(line, file=sys.stderr))
            tell_notes(name, clip.motion, lambda line: print(line, file=sys.stderr))
    return Viewer(runs, place, offset is None, overrides)
