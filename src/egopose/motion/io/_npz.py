"""Arrays from an ``.npz`` without trusting it: what it announces is checked before it is unpacked."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from egopose.core.errors import InputError

#: The most that is unpacked from one file, bytes, and the most numbers of one array: half an hour of AMASS at 120
#: frames/s. Readers turn every number into a double and hold about six copies.
MAX_UNPACKED_BYTES = 2**28
MAX_NUMBERS = 2**25
_MAX_ENTRIES = 1000

#: Bytes of the list of entries at the end of the archive: a thousand with names of 200 letters.
_MAX_DIRECTORY_BYTES = 2**18
_END_OF_DIRECTORY, _LOCATOR_64, _END_SIZE = b"PK\x05\x06", b"PK\x06\x07", 22


def entry_names(path: Path) -> list[str]:
    """Names of the arrays inside. Raises InputError like :func:`read_arrays`."""
    with _open(path) as archive:
        return [info.filename.removesuffix(".npy") for info in archive.infolist()]


def read_arrays(
    path: Path, names: Iterable[str], max_bytes: int | None = None, max_numbers: int | None = None
) -> dict[str, np.ndarray]:
    """Those of the named arrays that are there; objects (pickles) are refused.

    Args:
        path: of the file.
        names: of arrays.
        max_bytes: that are unpacked from the file; None for :data:`MAX_UNPACKED_BYTES`.
        max_numbers: of one array; None for :data:`MAX_NUMBERS`.

    Raises:
        InputError: not a zip, encrypted, more announced than is unpacked, an array whose header does not agree with its
            size, damaged data.
    """
    max_bytes = MAX_UNPACKED_BYTES if max_bytes is None else max_bytes
    max_numbers = MAX_NUMBERS if max_numbers is None else max_numbers
    arrays = {}
    with _open(path) as archive:
        there = {info.filename: info for info in archive.infolist()}
        wanted = [(name, there[f"{name}.npy"]) for name in names if f"{name}.npy" in there]
        total = sum(info.file_size for _, info in wanted)
        if total > max_bytes:
            cause = f"{total} bytes announced once unpacked; at most {max_bytes} are read"
            raise InputError(path, ", ".join(name for name, _ in wanted), cause)
        for name, info in wanted:
            try:
                arrays[name] = _read_array(path, name, archive, info, max_numbers)
            except InputError:
                raise
            except Exception as error:  # zipfile, zlib and NumPy raise whatever the damage happens to be
                raise InputError(path, name, f"damaged: {_one_line(error)}") from error
    return arrays


def _open(path: Path) -> zipfile.ZipFile:
    if not path.is_file():
        raise InputError(path, "path", "no such file" if not path.exists() else "is a folder or a device")
    _check_directory(path)
    try:
        archive = zipfile.ZipFile(path)
    except Exception as error:  # struct, zipfile and codecs raise whatever the damage happens to be
        cause = f"not an npz archive: {_one_line(error)}"
        raise InputError(path, "size" if path.stat().st_size == 0 else "zip", cause) from error
    entries = archive.infolist()
    if len(entries) > _MAX_ENTRIES or len({i.filename for i in entries}) != len(entries):
        archive.close()
        raise InputError(path, "zip", f"{len(entries)} entries, at most {_MAX_ENTRIES}, each name once")
    return archive


def _check_directory(path: Path) -> None:
    """The list of entries must be short: ``zipfile`` makes an object of each before anyone can count them."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(max(size - 2**16 - _END_SIZE, 0))
        tail = stream.read()
    at = tail.rfind(_END_OF_DIRECTORY)
    if at < 0 or at + _END_SIZE > len(tail):
        return  # zipfile says that this is no archive
    listed = int.from_bytes(tail[at + 12 : at + 16], "little")
    if listed > _MAX_DIRECTORY_BYTES or tail[max(at - 20, 0) : at].startswith(_LOCATOR_64):
        raise InputError(path, "zip", f"the list of entries takes more than {_MAX_DIRECTORY_BYTES} bytes")


def _one_line(error: Exception) -> str:
    return " ".join((str(error) or type(error).__name__).split())[:160]


def _read_array(path: Path, name: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo, max_numbers: int) -> np.ndarray:
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(path, name, f"compression {info.compress_type} is not one that NumPy writes")
    with archive.open(info) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise InputError(path, name, f"npy version {version} is not known")
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = header(stream)
        if dtype.hasobject:
            raise InputError(path, name, "holds pickled objects; only plain arrays are read")
        if dtype.kind not in "biuf" or dtype.subdtype is not None:
            raise InputError(path, name, f"holds {str(dtype)[:40]!r}, which are no numbers")
        if math.prod(shape) > max_numbers:
            raise InputError(path, name, f"shape {str(shape)[:60]}: more than {max_numbers} numbers")
        announced, there = math.prod(shape) * dtype.itemsize, info.file_size - stream.tell()
        if announced != there:
            raise InputError(path, name, f"shape {shape} of {dtype} takes {announced} bytes, {there} are there")
        raw = stream.read(announced)
    if len(raw) != announced:
        raise InputError(path, name, f"cut short: {len(raw)} of {announced} bytes")
    return np.frombuffer(raw, dtype=dtype).reshape(shape, order="F" if fortran else "C")
