"""Reading text without trusting it: size, encoding and emptiness are checked before anything is parsed."""

from __future__ import annotations

from pathlib import Path

from egopose.errors import InputError

#: The largest text file read, bytes. An hour of 100 joints at 60 frames/s is about 500 MB; mocap takes are minutes.
MAX_TEXT_BYTES = 256 * 2**20

#: No skeleton of a person has more joints; a file that announces more is broken or hostile.
MAX_JOINTS = 2048


def read_text(path: Path) -> str:
    r"""The file's text with ``\n`` line ends.

    Raises:
        InputError: missing, not a file, empty, over :data:`MAX_TEXT_BYTES`, binary, not UTF-8.
    """
    try:
        if not path.is_file():
            raise InputError(path, "path", "is a folder or a device" if path.exists() else "no such file")
        size = path.stat().st_size
        if size > MAX_TEXT_BYTES:
            raise InputError(path, "size", f"{size} bytes; at most {MAX_TEXT_BYTES} are read")
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(path, "path", f"cannot be read: {error.strerror}") from error
    if not raw.strip():
        raise InputError(path, "size", "the file is empty")
    zero = raw.find(b"\0")
    if zero >= 0:
        line = raw.count(b"\n", 0, zero) + 1
        raise InputError(path, f"line {line}", "zero byte: a binary file, not text")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise InputError(path, f"line {line}", f"byte 0x{raw[error.start]:02x} is not UTF-8 text") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def excerpt(text: str, limit: int = 40) -> str:
    """Text from a file made fit for one error line."""
    shown = text if len(text) <= limit else text[:limit] + "..."
    return repr(shown)
