"""What a video file says of itself before anything decodes it: its container, its codec, and what is wrong with it.

Three kinds of container are opened: MP4 and QuickTime (ISO/IEC 14496-12), AVI (RIFF), Matroska and WebM (RFC 9559).
FFmpeg would open anything it knows by its content: play lists, which name other files and addresses to be read, among
them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from egopose.core.errors import InputError

#: The kinds of box a movie file begins with.
_FIRST_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"uuid", b"styp")
#: Boxes looked through in one place; a movie of hours has a few dozen before its index.
_MAX_BOXES = 4096
#: Bytes at the beginning of AVI and Matroska files in which their tracks are described.
_HEAD = 2**18

_NAMES = {
    "av01": "AV1", "avc1": "H.264", "avc3": "H.264", "h264": "H.264", "hvc1": "H.265", "hev1": "H.265",
    "hevc": "H.265", "dvh1": "Dolby Vision", "dvhe": "Dolby Vision", "vvc1": "H.266", "mp4v": "MPEG-4",
    "xvid": "MPEG-4", "divx": "MPEG-4", "dx50": "MPEG-4", "fmp4": "MPEG-4",
    "mjpg": "Motion JPEG", "jpeg": "Motion JPEG",
    "vp08": "VP8", "vp80": "VP8", "vp09": "VP9", "vp90": "VP9", "cfhd": "CineForm", "encv": "encrypted video",
    "v_av1": "AV1", "v_vp8": "VP8", "v_vp9": "VP9", "v_mpeg4/iso/avc": "H.264", "v_mpegh/iso/hevc": "H.265",
    "v_mpeg4/iso/asp": "MPEG-4", "v_mjpeg": "Motion JPEG",
}  # fmt: skip
#: Codecs that every build of OpenCV decodes: where these give no picture, the file is damaged.
_EVERYWHERE = frozenset(("H.264", "H.265", "MPEG-4", "Motion JPEG", "VP8", "VP9"))


@dataclass(frozen=True)
class Container:
    """What stands in a file's head.

    Args:
        kind: ``"MP4"``, ``"AVI"`` or ``"Matroska"``.
        codec: the file's own code for how its pictures are packed (``"av01"``), ``""`` where it does not say.
        cut: what says that the file ends too early, ``""`` where nothing does.
    """

    kind: str
    codec: str
    cut: str = ""

    @property
    def codec_name(self) -> str:
        """``AV1 (av01)``, the bare code where its name is not known."""
        name = _NAMES.get(self.codec.lower())
        return f"{name} ({self.codec})" if name else self.codec or "an unnamed codec"

    @property
    def decoded_everywhere(self) -> bool:
        """Whether any build of OpenCV decodes this codec."""
        return not self.codec or _NAMES.get(self.codec.lower()) in _EVERYWHERE


def look_into(path: str | PathLike[str]) -> Container:
    """Kind, codec and cut of a video file.

    Raises:
        InputError: no such file, empty, none of the three containers, an MP4 without an index or a video track.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(path, "video", "is a folder or a device" if file.exists() else "no such file")
    size = file.stat().st_size
    if size == 0:
        raise InputError(path, "video", "the file is empty")
    with file.open("rb") as stream:
        start = stream.read(12)
        if start[4:8] in _FIRST_BOXES:
            return _mp4(path, stream, size)
        stream.seek(0)
        head = stream.read(_HEAD)
    if start[:4] == b"RIFF" and start[8:] == b"AVI ":
        # A stream's header: strh, its length, vids, and the code of its codec.
        if found := re.search(rb"strh....vids(....)", head, re.DOTALL):
            return Container("AVI", _code(found[1]))
        raise InputError(path, "video", "an AVI without a video track, or damaged")
    if start[:4] == b"\x1a\x45\xdf\xa3":
        # The element CodecID: 0x86, its length with one bit set, its text.
        if found := re.search(rb"\x86[\x81-\xbf](V_[A-Z0-9/_]{2,40})", head):
            return Container("Matroska", found[1].decode("ascii"))
        raise InputError(path, "video", "a Matroska file without a video track, or damaged")
    raise InputError(path, "video", "not an MP4, AVI or Matroska file: it does not begin as one does")


def _mp4(path: str | PathLike[str], stream: BinaryIO, size: int) -> Container:
    """Walks from the file's boxes to the description of each track."""
    cut, tracks, found = "", [], False
    for kind, start, end in boxes(stream, 0, size):
        if end > size:
            cut = f"cut short: the box {_code(kind)} should reach to byte {end}, the file has {size}"
        if kind == b"moov":
            found = True
            tracks = [
                (_handler(stream, body, stop), _sample_kind(stream, body, stop))
                for box, body, stop in boxes(stream, start, min(end, size))
                if box == b"trak"
            ]
    if not found:
        cause = "damaged: the index (box moov), which a camera writes last, is missing"
        raise InputError(path, "video", f"{cause}; {cut or 'the recording was not finished'}")
    videos = [codec for handler, codec in tracks if handler == b"vide"]
    if not videos:
        kinds = {b"soun": "sound", b"text": "text", b"tmcd": "time code", b"meta": "data"}
        listed = ", ".join(sorted({kinds.get(h, _code(h) or "unnamed") for h, _ in tracks})) or "none"
        raise InputError(path, "video", f"no video track in this MP4; its tracks: {listed}; damaged, or sound alone")
    return Container("MP4", _code(videos[0]), cut)


def boxes(stream: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, first byte of the content and last of the boxes in a part of the file; a box may reach beyond it."""
    for _ in range(_MAX_BOXES):
        if start + 8 > end:
            return
        stream.seek(start)
        head = stream.read(16)
        length, kind, body = int.from_bytes(head[:4], "big"), head[4:8], start + 8
        if length == 1:
            length, body = int.from_bytes(head[8:16], "big"), start + 16
        stop = end if length == 0 else start + length
        if stop < body:
            return
        yield kind, body, stop
        start = stop


def inside_box(stream: BinaryIO, start: int, end: int, *names: bytes) -> tuple[int, int] | None:
    """Content of the box that a path of names leads to."""
    for name in names:
        found = next(((s, e) for kind, s, e in boxes(stream, start, end) if kind == name), None)
        if found is None:
            return None
        start, end = found[0], min(found[1], end)
    return start, end


def _handler(stream: BinaryIO, start: int, end: int) -> bytes:
    """What a track is: ``vide``, ``soun`` ..."""
    return _read(stream, inside_box(stream, start, end, b"mdia", b"hdlr"), 8)


def _sample_kind(stream: BinaryIO, start: int, end: int) -> bytes:
    """The code of a track's codec."""
    return _read(stream, inside_box(stream, start, end, b"mdia", b"minf", b"stbl", b"stsd"), 12)


def _read(stream: BinaryIO, part: tuple[int, int] | None, offset: int) -> bytes:
    if part is None or part[0] + offset + 4 > part[1]:
        return b""
    stream.seek(part[0] + offset)
    return stream.read(4)


def _code(raw: bytes) -> str:
    """Four bytes as text fit for an error's line."""
    return "".join(chr(b) if 32 < b < 127 else "?" for b in raw).strip("?")
