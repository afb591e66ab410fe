"""The command ``egopose estimate`` on a film, beside the film's own length."""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import chain, cycle, islice
from pathlib import Path
from typing import Any

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.inference.progress import stage_seconds
from egopose.pipeline.dataset import motion_dataset
from egopose.vision.rendering import wearer_frames
from egopose.vision.takes import RenderConfig, take_seed
from egopose.vision.video import Frame, probe_video, write_video

_PREFIX = "film."
_SECONDS = 20
#: Of the film, pixels: a webcam's or an old telephone's.
_WIDTH, _HEIGHT = 640, 480


def run(overrides: Sequence[str], rounds: int) -> dict[str, Any]:
    """A film of the embedded clips, 640 x 480 pixels, through the command as a user gives it, libraries loaded anew.

    Args:
        overrides: of ``conf/estimate.yaml`` (``planner=ahead``, ``checkpoint=RUN``; without them the weights
            ``pretrained:people_estimation`` and no planner); ``film.seconds`` is the film's length.
        rounds: how often; medians count.

    Returns:
        ``real_time_factor`` (seconds of the command over seconds of film), ``processor_factor`` (of processor time,
        which other programs disturb less), ``stages`` (as ``real_time_factor``; ``starting`` is what is in none of the
        command's own stages), ``film_seconds``, ``size``, ``rounds``.

    Raises:
        InputError: a setting is unknown, or the command failed; its own words.
    """
    ours = dict(word.removeprefix(_PREFIX).split("=", 1) for word in overrides if word.startswith(_PREFIX))
    try:
        seconds = int(ours.pop("seconds", _SECONDS))
    except ValueError as error:
        raise InputError("bench estimate", "film.seconds", str(error)) from None
    if ours or not 1 <= seconds <= 3600:
        raise InputError("bench estimate", f"film.{next(iter(ours), 'seconds')}", "give film.seconds, 1 to 3600")
    words = ["checkpoint=pretrained:people_estimation", "planner=none"]
    words += [word for word in overrides if not word.startswith(_PREFIX)]
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        fps = float(compose_config("train")["vision"]["video"]["fps"])
        write_video(film, islice(_film(), round(seconds * fps)), fps)
        length = probe_video(film).frames / fps
        measured = [_measured([f"video={film}", f"out={folder}/out", *words]) for _ in range(rounds)]
    totals, busy, stages = zip(*measured, strict=True)
    return {
        "real_time_factor": statistics.median(totals) / length,
        "processor_factor": statistics.median(busy) / length,
        "stages": {name: statistics.median(one[name] for one in stages) / length for name in stages[0]},
        "film_seconds": length,
        "size": f"{_WIDTH} x {_HEIGHT}",
        "rounds": rounds,
    }


def _film() -> Iterator[Frame]:
    """What the wearers of the embedded clips see, one clip after another, without end."""
    config = compose_config("train")
    dataset, render = motion_dataset(config), RenderConfig.from_mapping(config["vision"])
    qpos, takes = dataset.reference["qpos"].numpy(), dataset.takes
    spans = [slice(first, first + count) for first, count in zip(takes.offsets, takes.lengths, strict=True)]
    cut = slice((_WIDTH - _HEIGHT) // 2, (_WIDTH + _HEIGHT) // 2)
    clips = (
        wearer_frames(
            dataset.humanoid.xml,
            qpos[span],
            room_seed=number,
            take_seed=take_seed(str(number)),
            room=render.room,
            camera=render.camera,
            size=_WIDTH,
            fps=render.fps,
        )
        for number, span in enumerate(cycle(spans))
    )
    return (frame[cut] for frame in chain.from_iterable(clips))


def _measured(words: Sequence[str]) -> tuple[float, float, dict[str, float]]:
    """Seconds, seconds of processor time, and seconds of each stage of one run of the command.

    Raises:
        InputError: it failed.
    """
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "egopose.estimate", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    total, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise InputError("bench estimate", "egopose estimate", (done.stderr.strip() or "failed").splitlines()[-1])
    stages = stage_seconds(done.stderr)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return total, busy, {"starting": total - sum(stages.values()), **stages}
