"""OpenPose's JSON in: a folder of ``*_keypoints.json``, one file a frame (its ``--write_json``, format 1.3)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.motion.rotations import Array
from egopose.scene.poses.following import Candidate, follow
from egopose.scene.poses.keypoints import BODY_25, COCO_18, KeypointSchema
from egopose.scene.poses.track import MAX_FRAMES, PoseTrack

#: Layouts by how many numbers a person has.
_LAYOUTS = {3 * len(schema): schema for schema in (BODY_25, COCO_18)}
_NUMBER = re.compile(r"(\d+)_keypoints\.json$")
#: The most people of a frame, and bytes of its file: OpenPose finds a few dozen at best.
_MAX_PEOPLE, _MAX_BYTES = 256, 2**21
#: Beyond any picture, px.
_FURTHEST = 1e5


def read_openpose(
    path: str | Path,
    *,
    fps: float | None = None,
    at: tuple[float, float] | None = None,
    image_size: tuple[int, int] | None = None,
) -> PoseTrack:
    """One person's keypoints from a folder of OpenPose's files.

    Frames go by the number in a file's name; a number that is missing is a frame in which nobody was found. Of several
    people the one followed stays the same, see :func:`~egopose.scene.poses.following.follow`.

    Args:
        path: the folder of one video.
        fps: its frames per second; OpenPose does not write them.
        at: px, a place on the person to follow in the first frame that has people.
        image_size: width and height of the pictures, px.

    Raises:
        InputError: no such files, one that OpenPose did not write, layouts that differ, keypoints scaled to 0..1,
            nobody in any frame; names file and field.
    """
    folder = Path(path)
    if fps is None or not 0 < fps <= 1e4:
        raise InputError(folder, "option fps", f"{fps!r:.40}: OpenPose does not write it; say fps=RATE of the video")
    files = _numbered(folder)
    first, last = min(files), max(files)
    people: list[list[Array]] = [[] for _ in range(last - first + 1)]
    for number, file in files.items():
        people[number - first] = _people(file)
    layouts = {len(rows) for found in people for rows in found}
    if not layouts:
        raise InputError(folder, "people", f"no frame of {len(people)} has anyone")
    if len(layouts) > 1:
        raise InputError(folder, "pose_keypoints_2d", "some files have BODY_25's keypoints and some COCO's")
    schema = _LAYOUTS[3 * layouts.pop()]
    _check_pixels(folder, people)
    candidates = [[_candidate(rows) for rows in found] for found in people]
    chain = follow(candidates, fps, at)
    return _track(schema, candidates, chain, fps, image_size)


def _numbered(folder: Path) -> dict[int, Path]:
    """Frame number -> file."""
    if not folder.is_dir():
        raise InputError(folder, "path", "is no folder; OpenPose's --write_json makes one of *_keypoints.json")
    out: dict[int, Path] = {}
    for file in folder.glob("*_keypoints.json"):
        match = _NUMBER.search(file.name)
        if match is None or len(match[1]) > 15:
            raise InputError(file, "name", "has no frame number before _keypoints.json")
        if int(match[1]) in out:
            raise InputError(folder, file.name, f"frame {match[1]} is there twice: keep the files of one video")
        out[int(match[1])] = file
    if not out:
        raise InputError(folder, "*_keypoints.json", "there are none; OpenPose's --write_json makes them")
    if max(out) - min(out) >= MAX_FRAMES:
        raise InputError(folder, "frames", f"numbered {min(out)} to {max(out)}; at most {MAX_FRAMES} are read")
    return out


def _people(file: Path) -> list[Array]:
    """``[K, 3]`` px and confidence for every person of a frame."""
    card = read_json(file, "people", _MAX_BYTES)
    people = card.get("people") if isinstance(card, dict) else None
    if not isinstance(people, list):
        raise InputError(file, "people", "is missing: this is no keypoint file of OpenPose")
    if len(people) > _MAX_PEOPLE:
        raise InputError(file, "people", f"there are {len(people)}; at most {_MAX_PEOPLE} are read")
    return [_rows(file, f"people[{k}].pose_keypoints_2d", person) for k, person in enumerate(people)]


def _rows(file: Path, field: str, person: Any) -> Array:
    values: Sequence[Any] | None = person.get("pose_keypoints_2d") if isinstance(person, dict) else None
    if not isinstance(values, list) or len(values) not in _LAYOUTS:
        there = f"{len(values)} numbers" if isinstance(values, list) else "no list"
        raise InputError(file, field, f"{there}; expected 75 (BODY_25) or 54 (COCO)")
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        raise InputError(file, field, "holds something that is no number")
    rows = np.array([float(value) for value in values]).reshape(-1, 3)
    if not (np.abs(rows) < _FURTHEST).all():
        raise InputError(file, field, "holds a number that is not finite or lies beyond any picture")
    if not ((rows[:, 2] >= 0) & (rows[:, 2] <= 1.1)).all():
        raise InputError(file, field, "holds a confidence outside 0 to 1")
    return rows


def _check_pixels(folder: Path, people: list[list[Array]]) -> None:
    """OpenPose can write shares of the picture; nothing says so in its files."""
    largest = max(float(np.abs(rows[:, :2]).max()) for found in people for rows in found)
    if largest <= 1.5:
        raise InputError(folder, "pose_keypoints_2d", "are shares of the picture: run OpenPose with --keypoint_scale 0")


def _candidate(rows: Array) -> Candidate:
    """OpenPose writes zeros where it found nothing."""
    confidence = np.clip(rows[:, 2], 0.0, 1.0)
    return Candidate(np.where(confidence[:, None] > 0, rows[:, :2], np.nan), confidence)


def _track(
    schema: KeypointSchema,
    candidates: list[list[Candidate]],
    chain: list[int],
    fps: float,
    image_size: tuple[int, int] | None,
) -> PoseTrack:
    frames, count = len(chain), len(schema)
    pixels, confidence = np.full((frames, count, 2), np.nan), np.zeros((frames, count))
    for t, k in enumerate(chain):
        if k >= 0:
            pixels[t], confidence[t] = candidates[t][k].pixels, candidates[t][k].confidence
    others = max(len(found) for found in candidates)
    notes = (f"up to {others} people were found in a frame; one was followed",) if others > 1 else ()
    return PoseTrack(schema, pixels, confidence, fps, image_size, notes=notes)
