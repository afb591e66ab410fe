"""Arrays from an ``.npz`` without trusting it: what it announces is checked before it is unpacked."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from egopose.errors import InputError

#: The most that is unpacked from one file, bytes.
MAX_UNPACKED_BYTES = 2**30
_MAX_ENTRIES = 1000


def entry_names(path: Path) -> list[str]:
    """Names of the arrays inside. Raises InputError like :func:`read_arrays`."""
    with _open(path) as archive:
        return [info.filename.removesuffix(".npy") for info in archive.infolist()]


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Those of the named arrays that are there; objects (pickles) are refused.

    Raises:
        InputError: not a zip, encrypted, more than :data:`MAX_UNPACKED_BYTES` announced, an array whose header does not
            agree with its size, damaged data.
    """
    arrays = {}
    with _open(path) as archive:
        there = {info.filename: info for info in archive.infolist()}
        wanted = [(name, there[f"{name}.npy"]) for name in names if f"{name}.npy" in there]
        total = sum(info.file_size for _, info in wanted)
        if total > MAX_UNPACKED_BYTES:
            cause = f"{total} bytes announced once unpacked; at most {MAX_UNPACKED_BYTES} are read"
            raise InputError(path, ", ".join(name for name, _ in wanted), cause)
        for name, info in wanted:
            try:
                arrays[name] = _read_array(path, name, archive, info)
            except (
                zipfile.BadZipFile,
                zlib.error,
                EOFError,
                ValueError,
                OSError,
                NotImplementedError,
                RuntimeError,
            ) as e:
                if isinstance(e, InputError):
                    raise
                raise InputError(path, name, f"damaged: {e}") from e
    return arrays


def _open(path: Path) -> zipfile.ZipFile:
    if not path.is_file():
        raise InputError(path, "path", "no such file" if not path.exists() else "is a folder or a device")
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise InputError(path, "size" if path.stat().st_size == 0 else "zip", f"not an npz archive: {error}") from error
    entries = archive.infolist()
    if len(entries) > _MAX_ENTRIES or len({i.filename for i in entries}) != len(entries):
        archive.close()
        raise InputError(path, "zip", f"{len(entries)} entries, at most {_MAX_ENTRIES}, each name once")
    return archive


def _read_array(path: Path, name: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise InputError(path, name, f"npy version {version} is not known")
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = header(stream)
        if dtype.hasobject:
            raise InputError(path, name, "holds pickled objects; only plain arrays are read")
        announced, there = math.prod(shape) * dtype.itemsize, info.file_size - stream.tell()
        if announced != there:
            raise InputError(path, name, f"shape {shape} of {dtype} takes {announced} bytes, {there} are there")
        raw = stream.read(announced)
    if len(raw) != announced:
        raise InputError(path, name, f"cut short: {len(raw)} of {announced} bytes")
    return np.frombuffer(raw, dtype=dtype).reshape(shape, order="F" if fortran else "C")
