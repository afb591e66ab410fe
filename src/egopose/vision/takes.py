"""Rendering the wearer's videos of many takes: in worker processes, resumable, with a progress bar."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from egopose.core.errors import InputError
from egopose.core.runtime import end_with_parent
from egopose.core.safe_io import read_json
from egopose.motion.rotations import Array
from egopose.vision.corruption import Corruption
from egopose.vision.film_takes import FilmRanges, draw_take, film_frames
from egopose.vision.gl import choose_backend
from egopose.vision.rendering import CameraConfig, render_wearer_video
from egopose.vision.rooms import RoomConfig, room_seed
from egopose.vision.video import write_video


@dataclass(frozen=True)
class RenderConfig:
    """Everything a rendered video depends on beside the motion (``conf/vision``)."""

    size: int
    fps: float
    room: RoomConfig
    camera: CameraConfig
    corruption: Corruption | None = None
    film: FilmRanges | None = None

    @classmethod
    def from_mapping(cls, cfg: Mapping[str, Any], corruption: Corruption | None = None) -> RenderConfig:
        """From the config group ``vision``.

        Raises:
            InputError: a key is missing, unknown or of the wrong form.
        """
        try:
            room, camera = ({k: _plain(v) for k, v in cfg[group].items()} for group in ("room", "camera"))
            size, fps = int(cfg["video"]["size"]), float(cfg["video"]["fps"])
            film = None if cfg.get("film") is None else FilmRanges.from_mapping(cfg["film"])
            return cls(size, fps, RoomConfig(**room), CameraConfig(**camera), corruption, film)
        except InputError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise InputError("conf/vision", "video, room, camera", f"{error}") from error


def _plain(value: Any) -> Any:
    """A config's list of two is a range."""
    if isinstance(value, int | float):
        return value
    low, high = value
    return (float(low), float(high))


@dataclass(frozen=True, eq=False)
class RenderJob:
    """One take to render.

    Args:
        name: of the take; the room and the way the camera is worn follow from it.
        model_xml: the humanoid's MJCF.
        qpos: ``[T, nq]`` at the config's frame rate.
        path: the MP4 to write.
        split: ``train`` or ``test``: from which rooms the take's is taken.
    """

    name: str
    model_xml: str
    qpos: Array
    path: Path
    split: str


def job_fingerprint(job: RenderJob, config: RenderConfig) -> str:
    """Changes with whatever changes the video."""
    digest = hashlib.sha256()
    # Videos from before there were corruptions and films stay valid.
    added = ("corruption", "film")
    known = {key: value for key, value in asdict(config).items() if key not in added or value is not None}
    settings = json.dumps([job.name, job.split, known], sort_keys=True)
    for part in (settings.encode(), job.model_xml.encode(), job.qpos.tobytes()):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()


def _record(path: Path) -> Path:
    return path.with_suffix(".json")


def is_rendered(job: RenderJob, config: RenderConfig) -> bool:
    """Whether the job's video is there, whole, and of just this motion and these settings."""
    record = _record(job.path)
    if not (job.path.is_file() and record.is_file()):
        return False
    try:
        return read_json(record, "fingerprint")["fingerprint"] == job_fingerprint(job, config)
    except (ValueError, KeyError, TypeError):
        return False


def take_seed(name: str) -> int:
    """What decides how the camera of the take of that name is worn and shakes."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")


def render_take(job: RenderJob, config: RenderConfig) -> int:
    """Render one take and write beside the MP4 what it shows; returns the number of frames."""
    seed = room_seed(job.name, job.split, config.room)
    if _record(job.path).exists():
        # Until the new video is there the old record must not vouch for the old one.
        _record(job.path).unlink()
    record = {"fingerprint": job_fingerprint(job, config), "take": job.name, "split": job.split, "room": seed}
    if config.film is not None:
        take = draw_take(take_seed(job.name), config.film, config.camera)
        frames = film_frames(
            job.model_xml, job.qpos, take, seed, config.room, config.size, config.fps, config.corruption
        )
        write_video(job.path, frames, config.fps)
        record |= {"camera": take.camera_record(), "place": take.place_record()}
    else:
        render_wearer_video(
            job.model_xml,
            job.qpos,
            job.path,
            room_seed=seed,
            take_seed=take_seed(job.name),
            room=config.room,
            camera=config.camera,
            size=config.size,
            fps=config.fps,
            corruption=config.corruption,
        )
    _record(job.path).write_text(json.dumps({**record, "frames": len(job.qpos), "rendered": True}, indent=1))
    return len(job.qpos)


def render_takes(jobs: Sequence[RenderJob], config: RenderConfig, workers: int, progress: bool = True) -> int:
    """Render those takes whose video is not there yet; returns how many were rendered.

    An interruption loses only the takes being rendered: each video appears whole, by renaming.

    Args:
        jobs: the takes; their paths differ.
        config: settings of all.
        workers: processes; 1 renders in this one.
        progress: show a bar.

    Raises:
        InputError: two takes would write one file; a video cannot be written.
        RuntimeError: no OpenGL here; the message says what to install.
    """
    if len({job.path for job in jobs}) != len(jobs):
        raise InputError("takes", "path", "two takes would write the same video")
    todo = [job for job in jobs if not is_rendered(job, config)]
    if not todo:
        return 0
    choose_backend()
    columns = [TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TextColumn("frames"), TimeRemainingColumn()]
    with Progress(*columns, disable=not progress) as bar:
        task = bar.add_task("rendering", total=sum(len(job.qpos) for job in todo))
        if workers == 1:
            for job in todo:
                bar.advance(task, render_take(job, config))
            return len(todo)
        # Spawned and not forked: neither OpenGL nor a parent's threads survive a fork.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context, initializer=end_with_parent) as pool:
            # Longest first, so that no worker is left with a long take at the end.
            ordered = sorted(todo, key=lambda job: -len(job.qpos))
            futures = [pool.submit(render_take, job, config) for job in ordered]
            try:
                for future in as_completed(futures):
                    bar.advance(task, future.result())
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return len(todo)
