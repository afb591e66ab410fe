"""The sync offset of a motion and the video of a camera on its head, found by how both turn.

The head's angular velocity is known from the motion, the camera's from optical flow. The camera sits on the head in a
way nobody measured: one rotation, the same in every frame. For each offset the best such rotation is found in closed
form (orthogonal Procrustes, Schönemann 1966), and with it the correlation of the two; the offset with the highest is
the answer, refined between frames by a parabola.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from scipy.spatial.transform import Slerp

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.prepare_motion import without_lead_in
from egopose.motion import rotations as rot
from egopose.motion.io import given_options, read_motion
from egopose.motion.mapping import identify
from egopose.motion.motion import Motion
from egopose.motion.notes import tell_notes
from egopose.motion.rotations import Array
from egopose.vision.camera_rotation import camera_rotation
from egopose.vision.flow import FlowConfig, flow_of_frames
from egopose.vision.lens import Camera, undo_rolling_shutter
from egopose.vision.video import Frame, probe_video, read_frames


@dataclass(frozen=True)
class SyncSettings:
    """``data.sync``; ``conf/data/own.yaml`` gives every value and its source.

    Args:
        rate: samples/s at which both are compared.
        overlap: share of the motion that the video must cover.
        apart: s; offsets nearer than this are one peak.
        confidence: least ratio of what the second-best offset leaves unexplained to what the best leaves.
        shortest: s of motion below which nothing is tried.
        field_of_view: degrees across the picture where the camera's is not said.
    """

    rate: float
    overlap: float
    apart: float
    confidence: float
    shortest: float
    field_of_view: float


@dataclass(frozen=True)
class Sync:
    """What was found.

    Args:
        offset: s; what the motion shows at t, the video shows at t + offset.
        correlation: of the two angular velocities there, 0 to 1.
        confidence: see :class:`SyncSettings`; 1 would be a tie.
    """

    offset: float
    correlation: float
    confidence: float


def head_turning(motion: Motion, rate: float, mapping: dict[str, str] | None = None) -> Array:
    """The head's angular velocity ``[T, 3]`` (rad/s, in the head's own axes); entry k is over k/rate .. (k+1)/rate.

    Args:
        motion: of any humanoid skeleton; the joint that plays the head is found by
            :func:`egopose.motion.mapping.identify`.
        rate: samples/s.
        mapping: part -> joint, as there.

    Raises:
        InputError: no head is found in the skeleton.
    """
    head = identify(motion.skeleton, mapping).parts["head"]
    _, quats = motion.forward_kinematics()
    count = int(np.floor(motion.duration * rate + 1e-6)) + 1
    if count < 2:
        return np.zeros((0, 3))
    times = np.minimum(np.arange(count) / rate, motion.duration)
    at = Slerp(np.arange(len(motion)) / motion.fps, rot.to_scipy(quats[:, head]))(times)
    sampled = rot.from_scipy(at, (count,))
    return rot.to_rotvec(rot.multiply(rot.conjugate(sampled[:-1]), sampled[1:])) * rate


def video_turning(
    path: str | PathLike[str], camera: Camera, flow: FlowConfig, rate: float, field_of_view: float
) -> Array:
    """The camera's angular velocity ``[T, 3]`` (rad/s, its own axes); entry k is over k/rate .. (k+1)/rate.

    Args:
        path: any MP4; a faster one is thinned to about ``rate``.
        camera: its lens, shutter and rate.
        flow: how flow is computed.
        rate: samples/s.
        field_of_view: degrees across the picture where ``camera`` does not say.

    Raises:
        InputError: the video cannot be read.
    """
    info = probe_video(path)
    rectify = camera.rectifier(info.width, info.height, flow.working_size)
    view = field_of_view if camera.field_of_view is None else camera.seen_view(info.width, info.height)
    times: list[float] = []

    def thinned() -> Iterator[Frame]:
        for time, frame in read_frames(path, camera.fps):
            if not times or time - times[-1] > 0.75 / rate:
                times.append(time)
                yield rectify(frame)

    turns = []
    for number, moved in enumerate(flow_of_frames(thinned(), flow)):
        if number:
            interval = times[number] - times[number - 1]
            if camera.delay:
                moved = undo_rolling_shutter(moved, camera.delay, interval)
            turns.append(camera_rotation(moved[None], view)[0] / interval)
    if len(turns) < 2:
        raise InputError(path, "video", "has fewer than 3 frames")
    # The middle row is exposed half a readout after the frame's stamp.
    edges = np.array(times) + 0.5 * camera.delay
    middles = 0.5 * (edges[:-1] + edges[1:])
    wanted = (np.arange(int(edges[-1] * rate)) + 0.5) / rate
    return np.stack([np.interp(wanted, middles, column) for column in np.array(turns).T], axis=1)


def unexplained(head: Array, camera: Array) -> float:
    """Share of the camera's turning ``[T, 3]`` that the head's ``[T, 3]``, rotated and scaled, does not explain.

    It is 1 - r^2, r the correlation under the best rotation between the two sets of axes; means are taken out (they are
    what a bias of either would be).
    """
    head, camera = head - head.mean(axis=0), camera - camera.mean(axis=0)
    power = float(np.sum(head**2) * np.sum(camera**2))
    if power == 0.0:
        return 1.0
    left, strength, right = np.linalg.svd(head.T @ camera)
    if np.linalg.det(left @ right) < 0:
        strength[2] = -strength[2]
    return 1.0 - float(np.sum(strength)) ** 2 / power


def find_offset(head: Array, camera: Array, settings: SyncSettings, source: str = "sync") -> Sync:
    """The offset at which a head's and a camera's turning agree best.

    Args:
        head: ``[T, 3]`` of :func:`head_turning`.
        camera: ``[U, 3]`` of :func:`video_turning`, at the same rate.
        settings: of the search.
        source: named in errors.

    Raises:
        InputError: the motion or the video is too short, or no offset stands out from the others.
    """
    seconds = len(head) / settings.rate
    if seconds < settings.shortest:
        raise InputError(
            source, "motion", f"lasts {seconds:.2f} s; to find an offset {settings.shortest:g} s are needed"
        )
    least = int(np.ceil(settings.overlap * len(head)))
    lags = np.arange(least - len(head), len(camera) - least + 1)
    if not len(lags):
        cause = f"lasts {len(camera) / settings.rate:.2f} s and cannot cover {settings.overlap:.0%} of {seconds:.2f} s"
        raise InputError(source, "video", cause)
    left = np.array([_at(head, camera, int(lag)) for lag in lags])
    best = int(np.argmin(left))
    between = 0.0
    if 0 < best < len(lags) - 1:
        before, here, after = np.log(np.maximum(left[best - 1 : best + 2], 1e-12))
        bend = before - 2 * here + after
        between = 0.5 * (before - after) / bend if bend > 0 else 0.0
    others = left[np.abs(lags - lags[best]) > settings.apart * settings.rate]
    confidence = float(others.min() / max(left[best], 1e-12)) if len(others) else 1.0
    result = Sync((float(lags[best]) + between) / settings.rate, float(np.sqrt(max(1.0 - left[best], 0.0))), confidence)
    if confidence < settings.confidence:
        raise InputError(
            source,
            "sync_offset",
            f"no offset stands out: {result.offset:.3f} s explains hardly more than another (confidence "
            f"{confidence:.2f}, {settings.confidence:g} is needed). Check that video and motion are of one take and at "
            f"their true speed (they last {len(camera) / settings.rate:.1f} and {seconds:.1f} s; a BVH's Frame Time, "
            "camera.fps), give a longer motion with quick turns of the head, or measure the offset at a clap and give "
            "it as a number",
        )
    return result


def _at(head: Array, camera: Array, lag: int) -> float:
    start, stop = max(0, -lag), min(len(head), len(camera) - lag)
    return unexplained(head[start:stop], camera[start + lag : stop + lag])


def sync_offset(
    video: str | PathLike[str],
    motion: Motion,
    settings: SyncSettings,
    flow: FlowConfig,
    camera: Camera | None = None,
    mapping: dict[str, str] | None = None,
) -> Sync:
    """The sync offset of a video and a motion, both as read; see the module.

    The motion's time 0 is its first frame, that of a T-pose before it left out, as in preparing it.

    Raises:
        InputError: either cannot be used, or no offset stands out.
    """
    head = head_turning(without_lead_in(motion), settings.rate, mapping)
    turning = video_turning(video, camera or Camera(), flow, settings.rate, settings.field_of_view)
    return find_offset(head, turning, settings, str(video))


def settings_of(data: Mapping[str, Any]) -> SyncSettings:
    """Of a resolved ``conf/data`` group.

    Raises:
        InputError: there are none, or one is wrong.
    """
    if not data.get("sync"):
        raise InputError("data", "sync", "is missing: offsets can be found with data=own, which has these settings")
    return from_mapping(SyncSettings, data["sync"], "data.sync")


def run_sync(config: Mapping[str, Any]) -> Sync:
    """The way of ``conf/sync.yaml``, resolved.

    Raises:
        InputError: video, motion or a setting cannot be used, or no offset stands out; says what to do then.
    """
    camera = Camera.from_mapping(config["data"]["camera"], "data.camera")
    motion = read_motion(str(config["motion"]), **given_options(config["reader"]))
    tell_notes(str(config["motion"]), motion, lambda line: print(line, file=sys.stderr))
    flow = FlowConfig(**config["vision"]["flow"])
    settings = settings_of(config["data"])
    return sync_offset(str(config["video"]), motion, settings, flow, camera, dict(config["mapping"]))
