"""Whether bad films are told from good ones by :func:`egopose.inference.film_agreement.film_agreement`.

The kinematic motion stands for the body. Good are all films of wearers, also of one who stands. Bad are films read with
the wrong lens, films in disorder, and films of no wearer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from egopose.benchmarks.film_cameras import Shot, motion_of, read_film, take, without_telemetry
from egopose.benchmarks.film_clips import bench_clip
from egopose.benchmarks.film_measures import area_interval, measures, share_in_order
from egopose.humanoid.model import HumanoidModel
from egopose.inference.film_agreement import film_agreement, steps_of
from egopose.inference.film_states import FilmReading
from egopose.motion.rotations import Array
from egopose.vision.bystander_films import drone_film, moving_picture_film, still_film
from egopose.vision.head_signal import HeadSignal
from egopose.vision.video import read_frames, write_video

#: Kinds of bad film that are rendered anew, for each place; disorder is made of good films.
BAD = ("said 60, is 120", "said 120, is 60", "drone", "drone at a cliff", "tripod", "moving picture")
DISORDER = ("frames shuffled", "half seconds shuffled")
#: s of a film without a wearer.
_SECONDS = 8.0
_PIECE = 15  # frames, half a second
_MOUNT = "head"


@dataclass(frozen=True)
class Judged:
    """A film's row for tables, and its score ``[T]`` frame by frame."""

    row: dict[str, Any]
    scores: Array = field(repr=False)


def judged(humanoid: HumanoidModel, reading: FilmReading, truth: Array | None = None) -> Judged:
    """The film's score with its parts and features, and the measures beside a truth ``[T, nq]`` where there is one."""
    motion = motion_of(humanoid, reading)
    agreement = film_agreement(humanoid, motion, reading, _MOUNT)
    known = {} if truth is None else measures(humanoid, motion, truth[: len(motion)])
    parts = {f"part_{name}": float(part.mean()) for name, part in agreement.parts.items()}
    told = features(reading.signal, 1.0 / humanoid.control_dt)
    return Judged({**known, "score": agreement.mean, **parts, **told}, agreement.score)


def features(signal: HeadSignal, fps: float) -> dict[str, float]:
    """Numbers of a film that may tell whether somebody wears its camera.

    ``rough``: share of turning and velocity that is quicker than 5 frames. ``rise``: vertical speed that is slow, over
    the speed along the ground. ``bob``: vertical velocity in the band of steps, root mean square, over that speed.
    ``peak``: share of that band's power in its strongest 0.5 Hz. ``pace``: heights a second along the ground.
    """
    moved = np.column_stack([signal.turning, signal.velocity])[1:]
    slow = gaussian_filter1d(moved, 2.0, axis=0, mode="nearest")
    up = signal.velocity[:, 2]
    pace = float(np.hypot(*gaussian_filter1d(signal.velocity[:, :2], 0.5 * fps, axis=0, mode="nearest").T).mean())
    steps = steps_of(up, fps)
    power = np.abs(np.fft.rfft(steps * np.hanning(len(steps)))) ** 2
    width = max(round(0.5 * len(steps) / fps), 1)
    most = np.convolve(power, np.ones(width), "valid").max() if len(power) >= width else power.sum()
    floor = max(pace, 0.05)
    return {
        "feature_rough": float(np.square(moved - slow).sum() / max(np.square(moved).sum(), 1e-9)),
        "feature_rise": float(np.abs(gaussian_filter1d(up, fps, mode="nearest")).mean() / floor),
        "feature_bob": float(np.sqrt(np.square(steps).mean()) / floor),
        "feature_peak": float(most / max(power.sum(), 1e-12)),
        "feature_pace": pace,
        "feature_turn_quality": float(signal.quality[:, 0].mean()),
        "feature_pitch_degrees": float(np.rad2deg(signal.tilt[:, 0].mean())),
    }


def bad_films(
    humanoid: HumanoidModel, shot: Shot, seconds: float, folder: Path, advance: Callable[[], None]
) -> Iterator[Judged]:
    """One film of each kind of :data:`BAD` about a shot's place and seed, and the good ones that were mistaken.

    Args:
        humanoid: of wearers.
        shot: the camera with which no wearer films, the place and the seed.
        seconds: of a film, at most.
        folder: for films.
        advance: is called for each kind.
    """
    frames = round(min(seconds, _SECONDS) * 30.0) + 1
    walk = bench_clip("walk", humanoid)[:frames]
    for kind, width, said in ((BAD[0], 120.0, 60.0), (BAD[1], 60.0, 120.0)):
        wide = replace(shot, width=width)
        path = without_telemetry(take(humanoid, walk, wide, folder))
        right = judged(humanoid, read_film(humanoid, path, wide.camera(imu=False)), walk)
        yield Judged({"kind": "good", **wide.about("", False), **right.row}, right.scores)
        wrong = replace(wide.camera(imu=False), field_of_view=said)
        yield _named(judged(humanoid, read_film(humanoid, path, wrong), walk), kind, wide, False)
        advance()
    path, settings, length = folder / "film.mp4", shot.settings(), (frames - 1) / 30.0
    stands = bench_clip("standing", humanoid)[:frames]
    makers: dict[str, Callable[[], object]] = {
        BAD[2]: lambda: drone_film(path, settings, length),
        BAD[3]: lambda: drone_film(path, settings, length, cliff=True),
        BAD[4]: lambda: still_film(path, settings, length),
        BAD[5]: lambda: moving_picture_film(humanoid.xml, stands, 30.0, path, settings),
    }
    for kind, make in makers.items():
        make()
        for imu in (True, False):
            reading = read_film(humanoid, path if imu else without_telemetry(path), shot.camera(imu))
            yield _named(judged(humanoid, reading), kind, shot, imu)
        advance()


def shuffled_films(humanoid: HumanoidModel, folder: Path, shot: Shot) -> Iterator[Judged]:
    """The film that was rendered last, its frames in disorder: each by itself, and pieces of half a second."""
    frames = [frame for _, frame in read_frames(folder / "film.mp4")]
    rng = np.random.default_rng([shot.seed, 14])
    pieces = np.array_split(np.arange(len(frames)), max(len(frames) // _PIECE, 2))
    orders = (rng.permutation(len(frames)), np.concatenate([pieces[i] for i in rng.permutation(len(pieces))]))
    camera = shot.camera(imu=False)
    for kind, order in zip(DISORDER, orders, strict=True):
        path = folder / "shuffled.mp4"
        write_video(path, (frames[i] for i in order), 30.0)
        yield _named(judged(humanoid, read_film(humanoid, path, camera)), kind, shot, False)


def areas(films: list[Judged]) -> list[dict[str, Any]]:
    """A row for each kind of bad film and way to read it, and for all kinds: areas with 95% intervals over films."""
    rows = []
    for imu in (True, False):
        good = [film for film in films if film.row["kind"] == "good" and film.row["imu"] == imu]
        bad = [film for film in films if film.row["kind"] != "good" and film.row["imu"] == imu]
        for kind in [*dict.fromkeys(film.row["kind"] for film in bad), "all"]:
            mine = [film for film in bad if kind in (film.row["kind"], "all")]
            if not good or not mine:
                continue
            means = [[np.array([film.row["score"]]) for film in some] for some in (good, mine)]
            frames = [[film.scores for film in some] for some in (good, mine)]
            row: dict[str, Any] = {"kind": kind, "imu": imu, "good": len(good), "bad": len(mine)}
            row["good_score"] = float(np.mean(means[0]))
            row["bad_score"] = float(np.mean(means[1]))
            for name, both in (("films", means), ("frames", frames)):
                row[name], row[f"{name}_low"], row[f"{name}_high"] = area_interval(*both)
            rows.append(row)
    return rows


def separation(films: list[Judged]) -> list[dict[str, Any]]:
    """Areas of each part and feature alone, without telemetry; below a half, bad films have more of it."""
    plain = [film.row for film in films if not film.row["imu"]]
    names = [name for name in plain[0] if name.startswith(("part_", "feature_"))] if plain else []
    good = [row for row in plain if row["kind"] == "good"]
    kinds = dict.fromkeys(row["kind"] for row in plain if row["kind"] != "good")
    return [
        {"kind": kind}
        | {
            name: share_in_order(
                np.array([row[name] for row in good]), np.array([row[name] for row in plain if row["kind"] == kind])
            )
            for name in names
        }
        for kind in kinds
    ]


def _named(film: Judged, kind: str, shot: Shot, imu: bool) -> Judged:
    return replace(film, row={"kind": kind, **shot.about("", imu), **film.row})
