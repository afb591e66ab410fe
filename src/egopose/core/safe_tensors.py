"""Safe readers of untrusted folders of tensors: they cannot run code and stay small.

A folder of memory-mapped tensors is more than tensors: its ``meta.json`` names the class to build, and what TensorDict
cannot map it reads from a pickle beside it. Here a folder is looked through first and all but plain tensors refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict
from torch import Tensor

from egopose.core.errors import InputError
from egopose.core.safe_io import MAX_FILES, read_json

#: The most a checkpoint's files may hold in sum: loading one copies it. Policies and regressors here take 1 to 100 MB.
MAX_CHECKPOINT_BYTES = 512 * 2**20

_DTYPES = {
    str(dtype): dtype
    for dtype in (
        *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
        *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
    )
}

_KEY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,200}")
_NOT_TENSORS = ("_type", "shape", "device")


class CopyOnWriteTensor(MemoryMappedTensor):
    """A tensor mapped from a file that nothing done to the tensor changes.

    Processes share the file's pages as long as they only read. A page that is written to becomes the writer's own.
    Sent to another process it goes by the file's name and is mapped there in the same way.
    """

    @classmethod
    def from_filename(
        cls, filename: str | Path, dtype: torch.dtype, shape: torch.Size | Sequence[int], index: Any = None
    ) -> CopyOnWriteTensor:
        """As ``MemoryMappedTensor.from_filename``, which maps every file it may write to for writing."""
        shape = torch.Size(shape)
        tensor = torch.from_file(str(filename), shared=False, dtype=dtype, size=shape.numel()).view(shape)
        out = cls(tensor if index is None else tensor[index])
        out.filename, out.index, out.parent_shape = filename, index, shape
        out._handler = None
        return out

    def _index_wrap(self, tensor: Any, item: Any, check: bool = False) -> Any:
        out = super()._index_wrap(tensor, item, check)
        if type(out) is MemoryMappedTensor:  # what a part of the tensor would be, and sent be mapped for writing
            out.__class__ = type(self)
        return out


def load_tensors(folder: Path, field: str, *, writable: bool = False) -> TensorDict:
    """A flat TensorDict mapped from a folder that was looked through first (:func:`check_tensors`).

    Args:
        folder: of ``meta.json`` and the tensors.
        field: what it is, for errors.
        writable: what is written to the tensors is written to their files; else to this process's memory alone.

    Raises:
        InputError: as :func:`check_tensors`, or the tensors do not fit together.
    """
    meta = check_tensors(folder, field)
    kind = MemoryMappedTensor if writable else CopyOnWriteTensor

    def mapped(key: str) -> Tensor:
        shape, dtype = torch.Size(meta[key]["shape"]), _DTYPES[meta[key]["dtype"]]
        if not shape.numel():  # a file of nothing cannot be mapped
            return torch.empty(shape, dtype=dtype)
        return kind.from_filename(folder / f"{key}.memmap", dtype, shape)

    try:
        return TensorDict({key: mapped(key) for key in meta if key not in _NOT_TENSORS}, batch_size=meta["shape"])
    except Exception as error:  # torch and tensordict raise whatever the damage happens to be
        raise InputError(folder, field, f"is damaged: {error}"[:300]) from None


def check_tensors(folder: Path, field: str) -> dict[str, Any]:
    """A folder of ``meta.json`` and ``*.memmap`` must hold plain tensors, each as long as it says, and nothing else.

    A file that was cut off would be mapped with zeros at its end in silence, one that is a link would let the owner of
    the folder have other files written to; pickles and classes other than TensorDict run code or import it. Other JSON
    files may stand beside them.

    Returns:
        ``meta.json``: the shape, and of every tensor its shape and type.

    Raises:
        InputError: names the folder, ``field`` and what stands there instead.
    """
    if folder.is_symlink() or not folder.is_dir():
        raise InputError(folder, field, "is missing, a link or no folder")
    for entry in folder.iterdir():
        if entry.is_symlink() or not entry.is_file() or entry.suffix not in (".json", ".memmap"):
            raise InputError(folder, field, f"is damaged: {entry.name[:60]!r} is no tensor and does not belong there")
    meta = read_json(folder / "meta.json", field)
    if not isinstance(meta, dict) or meta.get("_type") != str(TensorDict):
        raise InputError(folder, field, "is damaged: meta.json is not of a plain TensorDict")
    if meta.get("device") not in (None, "None", "cpu") or not _is_shape(meta.get("shape")):
        raise InputError(folder, field, "is damaged: meta.json has no shape, or another device than cpu")
    for key, entry in meta.items():
        if key in _NOT_TENSORS:
            continue
        if not _is_plain_tensor(key, entry):
            raise InputError(folder, field, f"is damaged: {key[:60]!r} is no plain tensor in meta.json")
        size = math.prod(entry["shape"]) * _DTYPES[entry["dtype"]].itemsize
        file = folder / f"{key}.memmap"
        there = file.stat().st_size if file.is_file() else 0
        if there < size:
            raise InputError(folder, field, f"is damaged: {file.name[:60]} is cut off or missing")
    return meta


def _is_plain_tensor(key: str, entry: Any) -> bool:
    return (
        _KEY.fullmatch(key) is not None
        and isinstance(entry, dict)
        and set(entry) <= {"device", "shape", "dtype", "is_nested"}
        and entry.get("is_nested", False) is False
        and entry.get("device") in (None, "cpu")
        and isinstance(entry.get("dtype"), str)
        and entry["dtype"] in _DTYPES
        and _is_shape(entry.get("shape"))
    )


def _is_shape(value: Any) -> bool:
    """A list of at most eight sizes whose product a file can have."""
    if not isinstance(value, list) or len(value) > 8:
        return False
    if not all(type(size) is int and 0 <= size < 2**48 for size in value):
        return False
    return math.prod(size for size in value if size) < 2**48


_CHECKPOINT_FILES = re.compile(
    r"manifest\.json|checksums\.json|components/[^/]+/(state\.json|value\.json|state/meta\.json|state/[^/]+\.memmap)"
)

#: What the states of networks, optimizers, generators and worlds are made of; TorchRL would read more.
_STATE_KINDS = {"value", "tensor", "dict", "ordered_dict", "list", "tuple", "numpy", "torch_size", "torch_dtype"}
_NUMPY_TYPES = re.compile(r"[<>|=]?[biufc](1|2|4|8|16)")


def check_checkpoint_files(folder: Path) -> None:
    """By their names a checkpoint's files must be JSON and tensors, of bounded size: to be called before any is read.

    Raises:
        InputError: a file that does not belong (``state.pt``, ``other.pickle``, an archive, a link), over
            :data:`MAX_CHECKPOINT_BYTES`.
    """
    total = 0
    for count, (name, path) in enumerate(_walk(folder)):
        if count > MAX_FILES:
            raise InputError(folder, "files", f"more than {MAX_FILES}: this is no checkpoint")
        if path.is_symlink():
            raise InputError(folder, name[:100], "is a link and does not belong to the checkpoint")
        if path.is_dir():
            continue
        if not path.is_file() or _CHECKPOINT_FILES.fullmatch(name) is None:
            raise InputError(folder, name[:100], "does not belong to the checkpoint")
        total += path.stat().st_size
        if total > MAX_CHECKPOINT_BYTES:
            raise InputError(
                folder, name[:100], f"more than {MAX_CHECKPOINT_BYTES} bytes in sum: this is no checkpoint"
            )


def check_checkpoint_states(folder: Path) -> None:
    """A checkpoint's states must be made of tensors and plain values: to be called before TorchRL loads them.

    Checksums do not help against someone who meant it: they lie in the same folder.

    Raises:
        InputError: a class, a pickle, a type or a kind of value that does not belong.
    """
    for component in sorted((folder / "components").glob("*")):
        name = f"components/{component.name}"
        if (component / "state").is_dir():
            check_tensors(component / "state", f"{name}/state")
        if (component / "state.json").is_file():
            _check_state(folder, f"{name}/state.json", read_json(component / "state.json", f"{name}/state.json"))


def _walk(folder: Path) -> Iterator[tuple[str, Path]]:
    """Everything in the folder, links not followed; names are relative to it."""
    waiting = [folder]
    while waiting:
        for path in waiting.pop().iterdir():
            yield path.relative_to(folder).as_posix(), path
            if path.is_dir() and not path.is_symlink():
                waiting.append(path)


def _check_state(folder: Path, name: str, state: Any) -> None:
    waiting, copied = [state], 0
    while waiting:
        value = waiting.pop()
        if isinstance(value, list):
            waiting += value
            continue
        kind = value.get("kind") if isinstance(value, dict) else None
        if not isinstance(kind, str) or kind not in _STATE_KINDS:
            raise InputError(folder, name, f"is damaged: {str(kind or value)[:60]!r} is no kind of value")
        if kind in ("tensor", "numpy"):
            key = value.get("key")
            if not isinstance(key, str) or _KEY.fullmatch(key) is None:
                raise InputError(folder, name, "is damaged: a tensor without a key")
            tensor = (folder / name).parent / "state" / f"{key}.memmap"
            copied += tensor.stat().st_size if tensor.is_file() else 0  # entries that share one would each copy it
            if copied > MAX_CHECKPOINT_BYTES:
                raise InputError(folder, name, f"is damaged: its tensors take more than {MAX_CHECKPOINT_BYTES} bytes")
        if kind == "numpy" and _NUMPY_TYPES.fullmatch(str(value.get("dtype"))) is None:
            raise InputError(folder, name, f"is damaged: {str(value.get('dtype'))[:60]!r} is no type of numbers")
        if kind in ("dict", "ordered_dict", "list", "tuple"):
            if not isinstance(value.get("items"), list):
                raise InputError(folder, name, f"is damaged: a {kind} without items")
            waiting.append(value["items"])
            if value.get("metadata") is not None:
                waiting.append(value["metadata"])
