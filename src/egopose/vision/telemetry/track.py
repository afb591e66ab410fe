"""The telemetry track of an MP4 or QuickTime file: its payloads and when each begins (ISO/IEC 14496-12)."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.vision.containers import boxes, inside_box

#: Payloads of a file: one a second, so a day.
MAX_PAYLOADS = 86_400
#: Bytes of all payloads together: a HERO11 takes 7 kB/s, a Fusion 24.
MAX_TELEMETRY_BYTES = 128 * 2**20
_MAX_SETTINGS_BYTES = 2**20


@dataclass(frozen=True)
class Track:
    """What a file holds of telemetry, not yet read.

    Args:
        payloads: one of the camera's blocks of entries each.
        starts: ``[P]`` s of the video.
        durations: ``[P]`` s.
        settings: entries that describe the whole film (the box ``GPMF`` of ``udta``), or ``b""``.
        width: of the picture, pixels; 0 where the file does not say.
        height: likewise.
    """

    payloads: tuple[bytes, ...]
    starts: Array
    durations: Array
    settings: bytes
    width: float
    height: float


def read_track(path: str | PathLike[str], stream: BinaryIO, size: int) -> Track | None:
    """The first telemetry track, or None where the file has neither one nor settings.

    Raises:
        InputError: its tables do not fit each other or the file, or hold too much.
    """
    movie = inside_box(stream, 0, size, b"moov")
    if movie is None:
        return None
    tracks = [(body, min(stop, movie[1])) for kind, body, stop in boxes(stream, *movie) if kind == b"trak"]
    width, height = next((s for t in tracks if (s := picture_size(stream, t)) is not None), (0.0, 0.0))
    settings = _settings(path, stream, movie)
    found = next((t for t in tracks if is_telemetry(stream, t)), None)
    if found is None:
        if not settings:
            return None
        return Track((), np.zeros(0), np.zeros(0), settings, width, height)
    starts, durations, places = _tables(path, stream, found)
    payloads = []
    for number, (offset, length) in enumerate(places.tolist()):
        if offset + length > size:
            cause = f"cut short: payload {number + 1} should end at byte {offset + length}, the file has {size}"
            raise InputError(path, "telemetry track", cause)
        stream.seek(offset)
        payloads.append(stream.read(length))
    return Track(tuple(payloads), starts, durations, settings, width, height)


def is_telemetry(stream: BinaryIO, track: tuple[int, int]) -> bool:
    """Whether a track box (first and last byte of what it holds) is one of GPMF."""
    place = inside_box(stream, *track, b"mdia", b"minf", b"stbl", b"stsd")
    if place is None or place[0] + 16 > place[1]:
        return False
    stream.seek(place[0] + 12)
    return stream.read(4) == b"gpmd"


def picture_size(stream: BinaryIO, track: tuple[int, int]) -> tuple[float, float] | None:
    """Width and height of a video track, as its sample description has them."""
    handler = inside_box(stream, *track, b"mdia", b"hdlr")
    place = inside_box(stream, *track, b"mdia", b"minf", b"stbl", b"stsd")
    if handler is None or place is None or place[0] + 44 > place[1]:
        return None
    stream.seek(handler[0] + 8)
    if stream.read(4) != b"vide":
        return None
    stream.seek(place[0] + 40)
    raw = stream.read(4)
    return float(int.from_bytes(raw[:2], "big")), float(int.from_bytes(raw[2:], "big"))


def _settings(path: str | PathLike[str], stream: BinaryIO, movie: tuple[int, int]) -> bytes:
    place = inside_box(stream, *movie, b"udta", b"GPMF")
    if place is None:
        return b""
    if place[1] - place[0] > _MAX_SETTINGS_BYTES:
        raise InputError(path, "box GPMF", f"{place[1] - place[0]} bytes; at most {_MAX_SETTINGS_BYTES} are read")
    stream.seek(place[0])
    return stream.read(place[1] - place[0])


def _tables(
    path: str | PathLike[str], stream: BinaryIO, track: tuple[int, int]
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Start and duration (s) of each payload, and its offset and length in bytes."""
    table = inside_box(stream, *track, b"mdia", b"minf", b"stbl")
    assert table is not None
    lengths = _lengths(path, stream, table)
    count = len(lengths)
    if lengths.sum() > MAX_TELEMETRY_BYTES:
        cause = f"{lengths.sum()} bytes of telemetry; at most {MAX_TELEMETRY_BYTES} are read"
        raise InputError(path, "telemetry track", cause)
    scale = _time_scale(path, stream, track)
    runs = _numbers(path, stream, table, b"stts", 2)
    # Counted before they are laid out: a few rows can announce more than fits any memory.
    if runs[:, 0].sum() != count:
        raise InputError(path, "box stts", f"is damaged: times of {runs[:, 0].sum()} payloads, not of {count}")
    ticks = np.repeat(runs[:, 1], runs[:, 0])
    durations = ticks / scale
    starts = np.concatenate([np.zeros(1), np.cumsum(durations)])[:count]
    return starts, durations, np.stack([_offsets(path, stream, table, lengths), lengths], axis=1)


def _offsets(
    path: str | PathLike[str], stream: BinaryIO, table: tuple[int, int], lengths: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Where each payload lies: chunks hold one or several, one behind the other."""
    wide = inside_box(stream, *table, b"co64") is not None
    chunks = _numbers(path, stream, table, b"co64" if wide else b"stco", 1, 8 if wide else 4)[:, 0]
    groups = _numbers(path, stream, table, b"stsc", 3)
    first, per = groups[:, 0] - 1, groups[:, 1]
    rising = len(groups) and first[0] == 0 and (np.diff(first) > 0).all() and first[-1] < max(len(chunks), 1)
    if not rising or (per < 1).any() or (per > len(lengths)).any():
        if not len(lengths):
            return np.zeros(0, np.int64)
        raise InputError(path, "box stsc", "is damaged: its chunks are not those of the track")
    held = np.repeat(per, np.diff(np.append(first, len(chunks))))
    if held.sum() < len(lengths):
        raise InputError(path, "box stsc", f"is damaged: chunks of {held.sum()} of {len(lengths)} payloads")
    used = int(np.searchsorted(np.cumsum(held), len(lengths))) + 1
    chunk = np.repeat(np.arange(used), held[:used])[: len(lengths)]
    before = np.cumsum(lengths) - lengths
    begins = np.flatnonzero(np.diff(chunk, prepend=-1))
    return chunks[chunk] + before - before[begins][chunk]


def _lengths(path: str | PathLike[str], stream: BinaryIO, table: tuple[int, int]) -> NDArray[np.int64]:
    place = inside_box(stream, *table, b"stsz")
    if place is None or place[0] + 12 > place[1]:
        raise InputError(path, "box stsz", "is missing or damaged: the sizes of the payloads")
    stream.seek(place[0] + 4)
    same, count = np.frombuffer(stream.read(8), ">u4").tolist()
    if count > MAX_PAYLOADS:
        raise InputError(path, "box stsz", f"{count} payloads; at most {MAX_PAYLOADS} are read")
    if same:
        return np.full(count, same, np.int64)
    if place[0] + 12 + 4 * count > place[1]:
        raise InputError(path, "box stsz", f"is damaged: shorter than its {count} payloads")
    return np.frombuffer(stream.read(4 * count), ">u4").astype(np.int64)


def _numbers(
    path: str | PathLike[str], stream: BinaryIO, table: tuple[int, int], name: bytes, columns: int, width: int = 4
) -> NDArray[np.int64]:
    """The rows of a table whose head is version, flags and count."""
    place = inside_box(stream, *table, name)
    label = f"box {name.decode()}"
    if place is None or place[0] + 8 > place[1]:
        raise InputError(path, label, "is missing or damaged")
    stream.seek(place[0] + 4)
    count = int.from_bytes(stream.read(4), "big")
    length = count * columns * width
    if count > MAX_PAYLOADS or place[0] + 8 + length > place[1]:
        raise InputError(path, label, f"is damaged: {count} rows do not fit")
    raw = stream.read(length)
    if len(raw) < length:
        raise InputError(path, label, "is cut short")
    values = np.frombuffer(raw, f">u{width}").reshape(count, columns)
    if (values > 2**62).any():
        raise InputError(path, label, "is damaged: a number beyond any file")
    return values.astype(np.int64)


def _time_scale(path: str | PathLike[str], stream: BinaryIO, track: tuple[int, int]) -> int:
    """Ticks a second of a track."""
    place = inside_box(stream, *track, b"mdia", b"mdhd")
    raw = b""
    if place is not None:
        stream.seek(place[0])
        raw = stream.read(24)
    scale = int.from_bytes(raw[20:24] if raw[:1] == b"\1" else raw[12:16], "big")
    if not scale:
        raise InputError(path, "box mdhd", "is missing or damaged: the track has no time scale")
    return scale
