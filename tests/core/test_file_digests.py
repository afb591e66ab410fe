"""SHA-256 of files: hashlib's own, worked out once, and never that of another content."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from egopose.core import file_digests
from egopose.core.file_digests import sha256_of


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Bytes of each file that was read, in order; files count as settled from their first moment on."""
    sizes: list[int] = []
    original = hashlib.file_digest

    def counting(stream, algorithm):
        sizes.append(os.fstat(stream.fileno()).st_size)
        return original(stream, algorithm)

    monkeypatch.setattr(hashlib, "file_digest", counting)
    monkeypatch.setattr(file_digests, "_SETTLED_AFTER", -(10**12))
    return sizes


def test_a_file_is_read_once(tmp_path: Path, hashed: list[int]) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"abc" * 1000)
    for _ in range(3):
        assert sha256_of(file) == hashlib.sha256(b"abc" * 1000).hexdigest()
    file.rename(tmp_path / "other")
    sha256_of(tmp_path / "other")
    assert sum(hashed) in (3000, 6000)  # file systems may count a renamed file as changed


@pytest.mark.parametrize("restored", [False, True], ids=["as-it-comes", "time-set-back"])
def test_a_change_of_equal_length_is_noticed(restored: bool, tmp_path: Path, hashed: list[int]) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"before")
    os.utime(file, ns=(10**18, 10**18))
    first, times = sha256_of(file), file.stat()
    while file.stat().st_ctime_ns == times.st_ctime_ns:  # stamps are a few ms apart
        file.write_bytes(b"behind")
    if restored:
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert sha256_of(file) == hashlib.sha256(b"behind").hexdigest() != first


def test_a_file_put_in_its_place_is_noticed(tmp_path: Path, hashed: list[int]) -> None:
    file, other = tmp_path / "file", tmp_path / "other"
    file.write_bytes(b"before")
    other.write_bytes(b"behind")
    sha256_of(file)
    os.replace(other, file)
    assert sha256_of(file) == hashlib.sha256(b"behind").hexdigest()


def test_a_file_just_written_is_not_trusted_by_its_times(tmp_path: Path) -> None:
    """Two changes within one stamp of the file system leave size and times equal."""
    file = tmp_path / "file"
    for content in (b"first.", b"second", b"third."):
        file.write_bytes(content)
        assert sha256_of(file) == hashlib.sha256(content).hexdigest()
