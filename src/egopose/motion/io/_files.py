"""Reading text without trusting it: size, encoding and emptiness are checked before anything is parsed."""

from __future__ import annotations

from pathlib import Path

from egopose.core.errors import InputError

#: The largest text file read, bytes: an hour of 30 joints at 60 frames/s. Text with one rare letter takes four times
#: its bytes in memory, and a reader holds it twice.
MAX_TEXT_BYTES = 128 * 2**20

#: Lines read one by one: eighteen minutes of an AMC file at 120 frames/s. More would not end within half a minute.
MAX_LINES = 4_000_000

#: The most numbers a motion may hold, frames times columns; a reader takes about 20 bytes for each.
MAX_VALUES = 2**26

#: No skeleton of a person has more joints; a file that announces more is broken or hostile.
MAX_JOINTS = 2048


def read_text(path: Path, limit: int = MAX_TEXT_BYTES) -> str:
    r"""The file's text with ``\n`` line ends.

    Raises:
        InputError: missing, not a file, empty, over ``limit`` bytes, over :data:`MAX_LINES`, binary, not UTF-8.
    """
    try:
        if not path.is_file():
            raise InputError(path, "path", "is a folder or a device" if path.exists() else "no such file")
        size = path.stat().st_size
        if size > limit:
            raise InputError(path, "size", f"{size} bytes; at most {limit} are read")
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
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines = text.count("\n")
    if lines > MAX_LINES:
        raise InputError(path, f"line {MAX_LINES}", f"{lines} lines; at most {MAX_LINES} are read")
    return text


def check_values(path: Path, field: str, frames: int, columns: int) -> None:
    """Raises InputError where a motion is too long to be held: more than :data:`MAX_VALUES` numbers."""
    if frames * columns > MAX_VALUES:
        cause = (
            f"{frames} frames of {columns} numbers; at most {MAX_VALUES} numbers are read: cut the motion into parts"
        )
        raise InputError(path, field, cause)


def excerpt(text: str, limit: int = 40) -> str:
    """Text from a file made fit for one error line."""
    shown = text if len(text) <= limit else text[:limit] + "..."
    return repr(shown)
