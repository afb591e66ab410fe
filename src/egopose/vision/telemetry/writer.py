"""Telemetry into an MP4 as a GoPro has it: a track of GPMF payloads, and the film's settings in the box ``GPMF``.

The file's own bytes keep their places, so no table of offsets has to be changed: its index becomes free space, and the
payloads and the index with one more track go behind everything.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np

from egopose.core.atomic_write import written_whole
from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.vision.containers import boxes, inside_box, look_into
from egopose.vision.telemetry.axes import FIRST_ORDER, from_camera, orientation
from egopose.vision.telemetry.klv import container, number_entry, text_entry
from egopose.vision.telemetry.lens_fields import across_diagonal, lens_letter
from egopose.vision.telemetry.samples import Samples, Telemetry
from egopose.vision.telemetry.track import is_telemetry, picture_size

#: Ticks a second of the track: whole numbers of frames at 24, 25, 30 and 60 frames/s, and at 1000/1001 of them.
_TICKS = 90_000
_MAX_INDEX_BYTES = 64 * 2**20
_MAX_FRAMES = 10_000_000
#: s before the first frame that a sample may be: time stamps have no sign, so all are this much later in the file.
_BEFORE = 1.0
#: SCAL of each stream, GoPro's own for HERO6 and HERO7; less where a value would not fit its 16 bits.
_SCALES = {"GYRO": 1878, "ACCL": 418, "GRAV": 32767, "CORI": 32767, "IORI": 32767, "MSKP": 1}
_NAMES = {
    "GYRO": "Gyroscope", "ACCL": "Accelerometer", "GRAV": "Gravity Vector", "CORI": "CameraOrientation",
    "IORI": "ImageOrientation", "MSKP": "MRV Frame Skip",
}  # fmt: skip
_UNITS = {"GYRO": "rad/s", "ACCL": "m/s\xb2"}
#: Identity matrix of the track header.
_MATRIX = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)


def write_gpmf_mp4(
    video_path: str | PathLike[str], out_path: str | PathLike[str], streams: Telemetry, fps: float
) -> None:
    """Write ``video_path`` with a telemetry track to ``out_path``, whole or not at all.

    Gyroscope, accelerometer, gravity, both orientations, field of view, lens, readout, stabilisation and model are
    written as a HERO11 does; GPS and trajectory are not. A payload holds the samples of about a second. Numbers are
    rounded to 16 bits: rates to 0.0003 rad/s, accelerations to 0.0012 m/s^2, times to a microsecond.

    Args:
        video_path: an MP4 with a video track, as :func:`egopose.vision.video.write_video` writes it.
        out_path: the MP4 to write; may be ``video_path``.
        streams: what the camera measured, in camera axes; samples are evenly spaced, and none before -1 s.
        fps: of the video.

    Raises:
        InputError: no MP4, one in fragments, samples that are not evenly spaced or not finite, no place to write to.
    """
    video = Path(video_path)
    if look_into(video).kind != "MP4":
        raise InputError(video, "video", "is no MP4; only those can hold a telemetry track")
    if not 1.0 <= fps <= 1000.0:
        raise InputError(video, "fps", f"{fps}; 1 to 1000")
    with video.open("rb") as stream:
        size = video.stat().st_size
        start, stop = _index(video, stream, size)
        frames, width, height = _video_track(video, stream, (start, stop))
        payloads, ticks = _payloads(video, streams, frames, fps)
        stream.seek(start - 4)
        # The name of a box stands right before what it holds, unless eight bytes of length come between.
        name_at = start - 4 if stream.read(4) == b"moov" else start - 12
        stream.seek(start)
        movie = _with_track(stream.read(stop - start), _settings(streams, width, height), payloads, ticks, size + 8)
        try:
            with written_whole(Path(out_path)) as out:
                stream.seek(0)
                shutil.copyfileobj(stream, out)
                out.seek(name_at)
                out.write(b"free")
                out.seek(size)
                out.write(_box(b"mdat", *payloads) + movie)
        except OSError as error:
            raise InputError(out_path, "telemetry", f"cannot be written: {error.strerror}") from error


def _index(video: Path, stream: BinaryIO, size: int) -> tuple[int, int]:
    """First and last byte of what the box ``moov`` holds."""
    top = list(boxes(stream, 0, size))
    start, stop = next((body, stop) for kind, body, stop in top if kind == b"moov")
    stream.seek(top[-1][1] - 8)
    if any(kind == b"moof" for kind, _, _ in top) or top[-1][2] != size or stream.read(4) == b"\0\0\0\0":
        raise InputError(video, "video", "is cut short, in fragments or without an end; write it anew first")
    if stop - start > _MAX_INDEX_BYTES:
        raise InputError(video, "index", f"{stop - start} bytes; at most {_MAX_INDEX_BYTES} are read")
    return start, stop


def _video_track(video: Path, stream: BinaryIO, index: tuple[int, int]) -> tuple[int, float, float]:
    """Frames, width and height of the video."""
    tracks = [(body, stop) for kind, body, stop in boxes(stream, *index) if kind == b"trak"]
    if any(is_telemetry(stream, track) for track in tracks):
        raise InputError(video, "telemetry track", "is there already")
    for track in tracks:
        seen, place = picture_size(stream, track), inside_box(stream, *track, b"mdia", b"minf", b"stbl", b"stsz")
        if seen is not None and place is not None:
            stream.seek(place[0] + 8)
            frames = int.from_bytes(stream.read(4), "big")
            if not 0 < frames <= _MAX_FRAMES:
                raise InputError(video, "frames", f"{frames} in the index; 1 to {_MAX_FRAMES}")
            return frames, *seen
    raise InputError(video, "video", "no video track whose size is told")


def _payloads(video: Path, telemetry: Telemetry, frames: int, fps: float) -> tuple[list[bytes], list[int]]:
    """Each payload and its duration in ticks."""
    step = max(round(fps), 1)
    first = np.arange(0, frames, step)
    # The reader finds the first frame's moment by a stream that has one sample a frame: skipped frames, of which there
    # are none. Newer cameras write it too.
    per_frame = Samples(np.arange(frames) / fps, np.zeros((frames, 1)))
    found = {
        "ACCL": _in_file_axes(telemetry.accelerometer, from_camera),
        "GYRO": _in_file_axes(telemetry.gyroscope, from_camera),
        "CORI": _in_file_axes(telemetry.camera_orientation, orientation),
        "IORI": _in_file_axes(telemetry.image_orientation, orientation),
        "GRAV": telemetry.gravity,
        "MSKP": per_frame,
    }
    streams = {key: samples for key, samples in found.items() if samples is not None and len(samples.times)}
    scales = {key: _scale(video, key, samples) for key, samples in streams.items()}
    edges = np.append(first[1:] / fps, np.inf)
    payloads, written = [], dict.fromkeys(streams, 0)
    for edge in edges:
        parts = [number_entry("DVID", "L", np.ones((1, 1))), text_entry("DVNM", telemetry.model or "EgoPose")]
        for key, samples in streams.items():
            begin, end = written[key], int(np.searchsorted(samples.times, edge - 1e-6))
            if end - begin > 65535:
                raise InputError(video, key, f"{end - begin} samples in a second; at most 65535")
            if end > begin:
                parts.append(_stream(key, samples.times[begin], end, samples.values[begin:end], scales[key]))
            written[key] = end
        payloads.append(container("DEVC", *parts))
    last = np.append(first, frames)
    return payloads, np.diff(np.round(last / fps * _TICKS).astype(np.int64)).tolist()


def _in_file_axes(samples: Samples | None, turn: Callable[[Array], Array]) -> Samples | None:
    return samples and Samples(samples.times, turn(samples.values))


def _stream(key: str, begin: float, total: int, values: Array, scale: int) -> bytes:
    parts = [
        number_entry("STMP", "J", np.array([[(begin + _BEFORE) * 1e6]])),
        number_entry("TSMP", "L", np.array([[float(total)]])),
        text_entry("STNM", _NAMES[key]),
    ]
    if key in _UNITS:
        parts += [text_entry("ORIN", FIRST_ORDER), text_entry("SIUN", _UNITS[key])]
    if scale != 1:
        parts.append(number_entry("SCAL", "s", np.array([[float(scale)]])))
    return container("STRM", *parts, number_entry(key, "s", values * scale))


def _scale(video: Path, key: str, samples: Samples) -> int:
    """What the stream's values are multiplied by to fill 16 bits; also checks the samples."""
    if not (np.isfinite(samples.values).all() and np.isfinite(samples.times).all()):
        raise InputError(video, key, "a sample is not finite")
    times = samples.times
    if times[0] < -_BEFORE:
        raise InputError(video, key, f"begins {-times[0]:.3f} s before the video; at most {_BEFORE:g} s")
    interval = (times[-1] - times[0]) / max(len(times) - 1, 1)
    even = times[0] + interval * np.arange(len(times))
    if len(times) > 1 and not (interval > 0 and np.abs(times - even).max() <= 0.1 * interval + 2e-6):
        raise InputError(video, key, "samples are not evenly spaced in time: resample them first")
    largest = float(np.abs(samples.values).max())
    return max(min(_SCALES[key], int(32767 / max(largest, 1e-9))), 1)


def _settings(telemetry: Telemetry, width: float, height: float) -> bytes:
    """What describes the whole film, as the box ``GPMF`` of ``udta`` holds it."""
    parts = [text_entry("MINF", telemetry.model or "EgoPose")]
    if telemetry.lens is not None:
        parts.append(text_entry("VFOV", lens_letter(telemetry.lens)))
    if telemetry.field_of_view is not None:
        diagonal = across_diagonal(telemetry.field_of_view, telemetry.lens, width, height)
        parts.append(number_entry("ZFOV", "f", np.array([[diagonal]])))
    if telemetry.readout is not None:
        parts.append(number_entry("SROT", "f", np.array([[1000.0 * telemetry.readout]])))
    if telemetry.stabilised is not None:
        parts += [text_entry("EISE", "Y" if telemetry.stabilised else "N")]
        parts += [text_entry("EISA", "HS EIS" if telemetry.stabilised else "N/A")]
    head = (number_entry("DVID", "L", np.ones((1, 1))), text_entry("DVNM", "Video Global Settings"))
    return container("DEVC", *head, container("STRM", *parts))


def _with_track(movie: bytes, settings: bytes, payloads: list[bytes], ticks: list[int], begin: int) -> bytes:
    """The box ``moov`` with one more track, whose first payload lies at byte ``begin``."""
    children = [(kind, movie[body:stop]) for kind, body, stop in boxes(BytesIO(movie), 0, len(movie))]
    head = next(content for kind, content in children if kind == b"mvhd")
    identity = int.from_bytes(head[-4:], "big")
    described = b"".join(content for kind, content in children if kind == b"udta")
    scale_at = 20 if head[:1] == b"\1" else 12
    scale = int.from_bytes(head[scale_at : scale_at + 4], "big")
    # Cameras put the settings before the tracks; telemetry-parser fails where nothing follows them.
    parts = [
        _box(b"mvhd", head[:-4], struct.pack(">I", identity + 1)),
        _box(b"udta", described, _box(b"GPMF", settings)),
    ]
    parts += [_box(kind, content) for kind, content in children if kind not in (b"mvhd", b"udta")]
    parts.append(_track(identity, scale, payloads, ticks, begin))
    return _box(b"moov", *parts)


def _track(identity: int, scale: int, payloads: list[bytes], ticks: list[int], begin: int) -> bytes:
    """The box ``trak``, as a GoPro writes it."""
    lengths = np.array([len(payload) for payload in payloads])
    places = begin + np.cumsum(lengths) - lengths
    total, count = sum(ticks), len(payloads)
    track_head = struct.pack(">IIIII", 0xF, 0, 0, identity, 0) + struct.pack(">I", round(total / _TICKS * scale))
    table = _box(
        b"stbl",
        _box(b"stsd", struct.pack(">II", 0, 1), _box(b"gpmd", struct.pack(">6xHI", 1, 0))),
        _box(b"stts", struct.pack(">II", 0, count), *(struct.pack(">II", 1, tick) for tick in ticks)),
        _box(b"stsc", struct.pack(">IIIII", 0, 1, 1, 1, 1)),
        _box(b"stsz", struct.pack(">III", 0, 0, count), lengths.astype(">u4").tobytes()),
        _box(b"co64", struct.pack(">II", 0, count), places.astype(">u8").tobytes()),
    )
    reference = _box(b"dref", struct.pack(">II", 0, 1), _box(b"url ", struct.pack(">I", 1)))
    information = _box(
        b"minf",
        _box(b"gmhd", _box(b"gmin", b"\0" * 16), _box(b"gpmd", b"\0" * 4)),
        _box(b"dinf", reference),
        table,
    )
    media = _box(
        b"mdia",
        _box(b"mdhd", struct.pack(">IIIII", 0, 0, 0, _TICKS, total), b"\0" * 4),
        _box(b"hdlr", b"\0" * 4, b"mhlrmeta", b"\0" * 12, b"\tGoPro MET"),
        information,
    )
    return _box(b"trak", _box(b"tkhd", track_head, b"\0" * 16, _MATRIX, b"\0" * 8), media)


def _box(kind: bytes, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack(">I4s", len(body) + 8, kind) + body
