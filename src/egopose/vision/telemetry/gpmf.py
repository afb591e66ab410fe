"""GoPro's telemetry, read from an MP4, a QuickTime file or a bare stream of GPMF."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.rotations import Array, continuous, normalize
from egopose.vision.telemetry.axes import named_order, orientation, to_camera
from egopose.vision.telemetry.clock import Block, first_frame, sample_times
from egopose.vision.telemetry.klv import Entry, read_entries
from egopose.vision.telemetry.lens_fields import across_width, lens_name
from egopose.vision.telemetry.samples import Samples, Telemetry
from egopose.vision.telemetry.track import MAX_PAYLOADS, MAX_TELEMETRY_BYTES, Track, read_track

#: s of a payload of a bare stream, which has no track to tell: 30 frames at 29.97 frames/s.
_PAYLOAD = 1.001
_COEFFICIENTS = ("POLY", "ZMPL", "ARUW", "ARWA")
#: A picture turned by less than this (rad) against the camera is not steadied: ten steps of the stored numbers.
_UNTURNED = 1e-3
#: The streams of numbers that are read.
_STREAMS = frozenset(("GYRO", "ACCL", "GRAV", "CORI", "IORI", "GPS5", "GPS9", "SROT", "MSKP", "LSKP", "SHUT", "ISOE"))
#: Samples of one stream: Fusion's 3200 Hz for an hour and a half.
_MAX_SAMPLES = 2**24
#: s: slower than any sensor that rolls.
_MOST_READOUT = 0.1


def read_telemetry(path: str | PathLike[str]) -> Telemetry | None:
    """What the camera measured while it filmed.

    Args:
        path: MP4 or QuickTime, or a bare stream of GPMF (``.raw``), whose payloads are taken for 1.001 s each where its
            samples have no stamps.

    Returns:
        None where the file has no telemetry, or is of another kind.

    Raises:
        InputError: no such file, or its telemetry is damaged, cut short or too large.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(path, "telemetry", "is a folder or a device" if file.exists() else "no such file")
    size = file.stat().st_size
    with file.open("rb") as stream:
        head = stream.read(8)
        if head[:4] != b"DEVC":
            track = read_track(path, stream, size) if head[4:8].isalnum() else None
            return None if track is None else _telemetry(path, track)
        if size > MAX_TELEMETRY_BYTES:
            raise InputError(path, "telemetry", f"{size} bytes; at most {MAX_TELEMETRY_BYTES} are read")
        return _telemetry(path, _bare(path, head + stream.read()))


def _bare(path: str | PathLike[str], data: bytes) -> Track:
    """A stream without a track: a payload begins where the first device comes again."""
    begins, at, first = [], 0, b""
    while at + 8 <= len(data) and data[at : at + 4] == b"DEVC":
        identity = data[at + 8 : at + 20]
        first = first or identity
        if identity == first:
            begins.append(at)
        if len(begins) > MAX_PAYLOADS:
            raise InputError(path, "telemetry", f"more than {MAX_PAYLOADS} payloads")
        at += 8 + (data[at + 5] * int.from_bytes(data[at + 6 : at + 8], "big") + 3) // 4 * 4
    payloads = tuple(data[a:b] for a, b in zip(begins, [*begins[1:], len(data)], strict=True))
    durations = np.full(len(payloads), _PAYLOAD)
    return Track(payloads, np.cumsum(durations) - durations, durations, b"", 0.0, 0.0)


def _telemetry(path: str | PathLike[str], track: Track) -> Telemetry:
    settings = read_entries(track.settings, path, "box GPMF")
    payloads = [read_entries(p, path, f"telemetry payload {k + 1}") for k, p in enumerate(track.payloads)]
    single = _single_values((settings, *payloads))
    streams, orders = _streams(path, payloads)
    frame = first_frame(streams)

    def samples(key: str, columns: int) -> Samples | None:
        blocks = [b for b in streams.get(key, ()) if b.count]
        if not blocks:
            return None
        if any(b.values.shape[1] < columns for b in blocks):
            raise InputError(path, key, f"{blocks[0].values.shape[1]} numbers a sample; expected {columns}")
        count = sum(b.count for b in blocks)
        if count > _MAX_SAMPLES:
            raise InputError(path, key, f"{count} samples; at most {_MAX_SAMPLES} are read")
        values = np.concatenate([b.values[:, :columns] for b in blocks])
        times = sample_times(blocks, track.starts, track.durations, frame)
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise InputError(path, key, "is damaged: the times of its samples do not rise")
        good = np.isfinite(values).all(axis=1)
        return Samples(times[good], values[good])

    def vectors(key: str) -> Samples | None:
        found = samples(key, 3)
        return found and Samples(found.times, to_camera(found.values, named_order(orders.get(key), model), path))

    names = [e.text() for group in (settings, *payloads[:1]) for e in _flat(group) if e.key == "MINF"]
    names += [e.text() for p in payloads for d in p[:1] for e in d.inner if e.key == "DVNM"]
    model = next((name for name in names if name), "")
    turned = _orientations(samples("IORI", 4))
    lens = lens_name(single["VFOV"].text()) if "VFOV" in single and single["VFOV"].text() else None
    return Telemetry(
        model=model,
        gyroscope=vectors("GYRO"),
        accelerometer=vectors("ACCL"),
        gravity=_directions(samples("GRAV", 3)),
        camera_orientation=_orientations(samples("CORI", 4)),
        image_orientation=turned,
        gps=samples("GPS9", 5) or samples("GPS5", 5),
        field_of_view=_field_of_view(single, lens, track),
        lens=lens,
        readout=_readout(single, streams),
        stabilised=_stabilised(single, turned),
        lens_coefficients={
            key: tuple(values.ravel().tolist())
            for key in _COEFFICIENTS
            if key in single and (values := single[key].numbers()) is not None
        },
    )


def _flat(entries: Sequence[Entry]) -> Iterator[Entry]:
    for entry in entries:
        yield entry
        yield from _flat(entry.inner)


def _single_values(groups: Sequence[Sequence[Entry]]) -> dict[str, Entry]:
    """The first entry of each name that describes the whole film; the settings' box comes first."""
    wanted = {"VFOV", "ZFOV", "SROT", "EISE", "EISA", *_COEFFICIENTS}
    found: dict[str, Entry] = {}
    for group in groups[:2]:  # what is true of the film stands in the settings, or in the first payload
        for entry in _flat(group):
            if entry.key in wanted and entry.body:
                found.setdefault(entry.key, entry)
    return found


def _streams(
    path: str | PathLike[str], payloads: Sequence[Sequence[Entry]]
) -> tuple[dict[str, list[Block]], dict[str, str]]:
    """The blocks of each stream of numbers, and ORIN where there is one.

    A name that several devices have (a camera and what is paired with it) is that of the first which has it.
    """
    streams: dict[str, list[Block]] = {}
    orders: dict[str, str] = {}
    owner: dict[str, bytes] = {}
    for number, payload in enumerate(payloads):
        for device in payload:
            identity = next((e.body for e in device.inner if e.key == "DVID"), b"")
            for stream in device.inner:
                if stream.key != "STRM" or not stream.inner:
                    continue
                *about, last = stream.inner
                if last.key not in _STREAMS or owner.setdefault(last.key, identity) != identity:
                    continue
                described = {e.key: e for e in about}
                block = _block(path, number, described, last)
                if block is not None:
                    streams.setdefault(last.key, []).append(block)
                if "ORIN" in described:
                    orders.setdefault(last.key, described["ORIN"].text())
    return streams, orders


def _block(path: str | PathLike[str], number: int, about: dict[str, Entry], last: Entry) -> Block | None:
    values = last.numbers(about["TYPE"].text() if "TYPE" in about else None)
    if values is None:
        return None
    scale = about["SCAL"].numbers() if "SCAL" in about else None
    if scale is not None and scale.size:
        divisor = scale.ravel()
        if divisor.size not in (1, values.shape[1]) or not (np.isfinite(divisor) & (divisor != 0)).all():
            cause = f"SCAL has {divisor.size} numbers for {values.shape[1]}, or a zero"
            raise InputError(path, f"telemetry payload {number + 1}: {_plain(last.key)}", cause)
        with np.errstate(over="ignore"):  # what is too large is not finite, and left out
            values = values / divisor
    stamp = about["STMP"].numbers() if "STMP" in about else None
    total = about["TSMP"].numbers() if "TSMP" in about else None
    return Block(
        number,
        len(values),
        values,
        None if stamp is None or not stamp.size else float(stamp.flat[0]) / 1e6,
        None if total is None or not total.size or not np.isfinite(total.flat[0]) else int(total.flat[0]),
    )


def _plain(key: str) -> str:
    return "".join(c if " " < c < "\x7f" else "?" for c in key)


def _directions(samples: Samples | None) -> Samples | None:
    """Unit vectors; HERO8 writes zeros, which say nothing."""
    if samples is None:
        return None
    length = np.linalg.norm(samples.values, axis=1)
    good = length > 0.5
    return Samples(samples.times[good], samples.values[good] / length[good, None]) if good.any() else None


def _orientations(samples: Samples | None) -> Samples | None:
    if samples is None:
        return None
    length = np.linalg.norm(samples.values, axis=1)
    good = np.abs(length - 1.0) < 0.1
    if not good.any():
        return None
    unit: Array = normalize(samples.values[good])
    return Samples(samples.times[good], continuous(orientation(unit)))


def _field_of_view(single: dict[str, Entry], lens: str | None, track: Track) -> float | None:
    """ZFOV is across the diagonal (GoPro's answer in gpmf-parser's issue 164)."""
    values = single["ZFOV"].numbers() if "ZFOV" in single else None
    if values is None or not values.size or not track.width or not track.height:
        return None
    diagonal = float(values.flat[0])
    if not 1.0 <= diagonal <= (175.0 if lens == "linear" else 250.0):
        return None
    return across_width(diagonal, lens, track.width, track.height)


def _readout(single: dict[str, Entry], streams: dict[str, list[Block]]) -> float | None:
    """SROT, in ms: one value for the film since HERO8, one a frame in HERO7."""
    values = single["SROT"].numbers() if "SROT" in single else None
    if streams.get("SROT"):
        values = np.concatenate([b.values[:, :1] for b in streams["SROT"]])
    if values is None or not values.size:
        return None
    readout = float(np.median(values)) / 1000.0
    return readout if 0.0 <= readout <= _MOST_READOUT else None


def _stabilised(single: dict[str, Entry], turned: Samples | None) -> bool | None:
    """By EISE, else by EISA (``N``, ``N/A`` or the name of the way), else by whether pictures were turned."""
    for key in ("EISE", "EISA"):
        if key in single and (said := single[key].text().upper()):
            return said not in ("N", "N/A", "NO", "NONE", "OFF")
    if turned is None:
        return None
    return bool((2 * np.linalg.norm(turned.values[:, 1:], axis=1)).max() > _UNTURNED)
