"""GPMF's entries: key, type, size, number, values, padded to four bytes (github.com/gopro/gpmf-parser, README).

``telemetry-parser`` reads them too. Of the files here it opens only the MP4, refuses bare streams, has no camera axes,
and gives no times of quaternions, no gravity and no lens fields. So the reader is ours; the tests compare the two.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.rotations import Array

#: Entries within entries: device, stream, values, and room for more.
_MAX_DEPTH = 8
#: Entries in one payload; a HERO11 has some 400 in its second.
_MAX_ENTRIES = 100_000

_NUMBERS = {
    "b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "f": ">f4", "d": ">f8", "j": ">i8",
    "J": ">u8",
}  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """One entry; ``inner`` holds those of a container, whose ``kind`` is the zero character."""

    key: str
    kind: str
    size: int
    count: int
    body: bytes
    inner: tuple[Entry, ...] = ()

    def text(self) -> str:
        """Printable characters up to the first zero, 255 at most."""
        told = self.body[:255].split(b"\0")[0].decode("latin1")
        return "".join(c for c in told if c.isprintable()).strip()

    def numbers(self, complex_type: str | None = None) -> Array | None:
        """``[count, columns]``, or None where the entry holds no numbers.

        Args:
            complex_type: TYPE of the stream, for values of several types (kind ``?``).
        """
        kinds = self.kind if self.kind != "?" else (complex_type or "")
        if not kinds or any(kind not in _NUMBERS for kind in kinds):
            return None
        if self.kind != "?":
            item = np.dtype(_NUMBERS[kinds])
            if not self.size or self.size % item.itemsize:
                return None
            shape = (self.count, self.size // item.itemsize)
            return np.frombuffer(self.body, item).reshape(shape).astype(np.float64) if self.count else np.zeros(shape)
        row = np.dtype([(f"f{i}", _NUMBERS[kind]) for i, kind in enumerate(kinds)])
        if row.itemsize != self.size:
            return None
        table = np.frombuffer(self.body, row) if self.count else np.zeros(0, row)
        return np.stack([table[name].astype(np.float64) for name in row.names or ()], axis=1)


def read_entries(data: bytes, source: str | PathLike[str], place: str) -> tuple[Entry, ...]:
    """All entries of a payload.

    Args:
        data: the payload.
        source: the file, for the error.
        place: which payload, for the error.

    Raises:
        InputError: an entry reaches beyond what holds it, too many, too deeply nested.
    """
    left = [_MAX_ENTRIES]
    return tuple(_entries(data, 0, left, source, place))


def _entries(data: bytes, depth: int, left: list[int], source: str | PathLike[str], place: str) -> Iterator[Entry]:
    if depth > _MAX_DEPTH:
        raise InputError(source, place, f"is damaged: entries nested more than {_MAX_DEPTH} deep")
    at = 0
    # Zeros at the end pad a payload.
    while at + 8 <= len(data) and data[at : at + 4] != b"\0\0\0\0":
        left[0] -= 1
        if left[0] < 0:
            raise InputError(source, place, f"is damaged: more than {_MAX_ENTRIES} entries")
        key = data[at : at + 4].decode("latin1")
        size, count = data[at + 5], int.from_bytes(data[at + 6 : at + 8], "big")
        body = data[at + 8 : at + 8 + size * count]
        if len(body) < size * count:
            name = key if key.isprintable() else "?"
            cause = f"is damaged or cut short: {name} has {len(body)} of {size * count} bytes"
            raise InputError(source, place, cause)
        kind = chr(data[at + 4])
        inner = tuple(_entries(body, depth + 1, left, source, place)) if kind == "\0" else ()
        yield Entry(key, kind, size, count, body, inner)
        at += 8 + (size * count + 3) // 4 * 4


def container(key: str, *inner: bytes) -> bytes:
    """The bytes of an entry that holds others."""
    body = b"".join(inner)
    # Entries fill whole words, so four bytes are a fair unit for what one would not count.
    return _entry(key, "\0", 1 if len(body) <= 65535 else 4, body)


def text_entry(key: str, text: str) -> bytes:
    """The bytes of an entry of characters, one value of as many as there are."""
    raw = text.encode("latin1")
    return _entry(key, "c", min(len(raw), 255) or 1, raw[:255] or b"\0")


def number_entry(key: str, kind: str, values: Array) -> bytes:
    """The bytes of an entry of numbers ``[N, columns]``, rounded where the type is whole."""
    item = np.dtype(_NUMBERS[kind])
    wanted = values if item.kind == "f" else np.round(values)
    return _entry(key, kind, item.itemsize * values.shape[1], wanted.astype(item).tobytes())


def _entry(key: str, kind: str, size: int, body: bytes) -> bytes:
    count = len(body) // size
    assert size <= 255
    assert count <= 65535
    return struct.pack(">4sBBH", key.encode(), ord(kind), size, count) + body + b"\0" * (-len(body) % 4)
