"""Reading text without trusting it: size, encoding and emptiness are checked before anything is parsed."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from egopose.core.errors import InputError
from egopose.motion.joint_names import JAPANESE_WORDS

#: The largest text file read, bytes: an hour of 30 joints at 60 frames/s. Text with one rare letter takes four times
#: its bytes in memory, and a reader holds it twice.
MAX_TEXT_BYTES = 128 * 2**20

#: Lines read one by one: eighteen minutes of an AMC file at 120 frames/s. More would not end within half a minute.
MAX_LINES = 4_000_000

#: The most numbers a motion may hold, frames times columns; a reader takes about 20 bytes for each.
MAX_VALUES = 2**26

#: No skeleton of a person has more joints; a file that announces more is broken or hostile.
MAX_JOINTS = 2048


#: What text editors put before UTF-16, which is full of zero bytes otherwise.
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)

#: Bytes by which an encoding is told: those of the longest hierarchy.
_SAMPLE = 2**20

_JAPANESE = re.compile("[\u3040-\u30ff\u3400-\u9fff\uff01-\uff5e]+")


def read_text(path: Path, limit: int = MAX_TEXT_BYTES, encoding: str = "auto") -> str:
    r"""The file's text with ``\n`` line ends.

    Args:
        path: the file.
        limit: bytes.
        encoding: a codec Python knows, or ``"auto"``: UTF-8, UTF-16 with its mark, Shift-JIS, else Western European.

    Raises:
        InputError: missing, not a file, empty, over ``limit`` bytes, over :data:`MAX_LINES`, binary, not of the
            encoding; with ``"auto"`` also where a single byte is not UTF-8, which is damage more often than a letter.
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
    text = _decoded(path, raw, encoding).removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.count("\n")
    if lines > MAX_LINES:
        raise InputError(path, f"line {MAX_LINES}", f"{lines} lines; at most {MAX_LINES} are read")
    return text


def _decoded(path: Path, raw: bytes, encoding: str) -> str:
    guess = encoding == "auto"
    if guess:
        encoding = "utf-16" if raw.startswith(_UTF_16) else "utf-8-sig"
    else:
        try:
            "a".encode(encoding)
        except (LookupError, ValueError, TypeError):
            raise InputError(path, "option encoding", f"{excerpt(str(encoding))} is no encoding of text") from None
    zero = -1 if re.match("utf.?(16|32)", encoding, re.IGNORECASE) else raw.find(b"\0")
    if zero >= 0:
        line = raw.count(b"\n", 0, zero) + 1
        raise InputError(path, f"line {line}", "zero byte: a binary file, not text")
    try:
        return raw.decode(encoding)
    except UnicodeError as error:
        text = _decoded_otherwise(raw) if encoding == "utf-8-sig" and guess else None
        if text is not None:
            return text
        start = getattr(error, "start", 0)
        line = raw.count(b"\n", 0, start) + 1
        named = "UTF-8" if encoding == "utf-8-sig" else encoding
        cause = f"byte 0x{raw[start]:02x} is not {named} text; the option encoding names another (latin-1, cp932 ...)"
        raise InputError(path, f"line {line}", cause) from error


def _decoded_otherwise(raw: bytes) -> str | None:
    """Text in an encoding from before UTF-8, or None where the bytes speak for none.

    Shift-JIS is taken where what it gives is Japanese: words of joints, or signs that stand together. By chance a
    letter with an accent and the one after it make one sign, which stands alone.
    """
    if len(raw.translate(None, delete=bytes(range(128)))) < 2:
        return None
    sample = raw[:_SAMPLE].decode("cp932", errors="replace")
    runs = _JAPANESE.findall(sample)
    fitting = sum(len(run) for run in runs if len(run) > 1 or run in JAPANESE_WORDS)
    japanese = fitting > 0.5 * sum(letter > "\x7f" for letter in sample)
    for encoding in ("cp932", "cp1252") if japanese else ("cp1252",):
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            continue
    return None


def numbers_apart(line: str, count: int) -> list[str]:
    """The line's numbers where some have no blank between them, as columns of a fixed width have.

    A sign within a word begins a number, unless it is of an exponent. Where that does not give ``count``, all must have
    as many decimals as the line's last number. What still is not ``count`` words is left for the caller to refuse.
    """
    words = re.sub(r"(?<=[0-9.])(?=[-+])", " ", line).split()
    if len(words) < count and (match := re.search(r"\.([0-9]+)\s*$", line)):
        words = re.findall(rf"[-+]?[0-9]*\.[0-9]{{{len(match[1])}}}|[^\s]+", line)
    return words


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
