"""Reading what may come from strangers: JSON, YAML and folders of tensors that can run nothing and stay small.

A folder of memory-mapped tensors is more than tensors: its ``meta.json`` names the class to build, and what TensorDict
cannot map it reads from a pickle beside it. Here a folder is looked through first and all but plain tensors refused.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf
from tensordict import TensorDict

from egopose.core.errors import InputError

#: The largest JSON or YAML read, bytes: as Python objects it takes up to some forty times as much.
MAX_JSON_BYTES = 16 * 2**20
MAX_YAML_BYTES = 2**18
_MAX_YAML_VALUES = 50_000
_MAX_YAML_DEPTH = 50

#: The most a checkpoint's files may hold in sum: loading one copies it. Policies and regressors here take 1 to 100 MB.
MAX_CHECKPOINT_BYTES = 512 * 2**20
_MAX_FILES = 20_000

_DTYPES = {
    str(dtype): dtype
    for dtype in (
        *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
        *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
    )
}
_KEY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,200}")
_NOT_TENSORS = ("_type", "shape", "device")


def read_json(path: Path, field: str, limit: int = MAX_JSON_BYTES) -> Any:
    """The values of a JSON file.

    Args:
        path: the file.
        field: what it is, for the error.
        limit: bytes read at most.

    Raises:
        InputError: missing, over the limit, a link to somewhere else, not JSON, nested too deeply.
    """
    try:
        if path.is_symlink() or not path.is_file():
            raise InputError(path, field, "is missing, a link or no file")
        if path.stat().st_size > limit:
            raise InputError(path, field, f"is damaged: {path.stat().st_size} bytes; at most {limit} are read")
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise InputError(path, field, "is damaged: nested too deeply") from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, field, f"is damaged: {error}"[:200]) from None


def read_yaml(path: Path, field: str) -> Any:
    """Plain values of a YAML file, as Hydra reads them; interpolations stay the text they are.

    Raises:
        InputError: missing, over :data:`MAX_YAML_BYTES`, not YAML, a tag that would build an object, an alias (a few
            hundred bytes of aliases can say more than fits any memory), nested too deeply.
    """
    try:
        if not path.is_file():
            raise InputError(path, field, "is missing")
        if path.stat().st_size > MAX_YAML_BYTES:
            raise InputError(path, field, f"is damaged: {path.stat().st_size} bytes; at most {MAX_YAML_BYTES} are read")
        text = path.read_text(encoding="utf-8")
        depth = 0
        for count, event in enumerate(yaml.parse(text, Loader=yaml.SafeLoader)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_YAML_DEPTH:  # every level makes every further word slower
                raise InputError(path, field, "is damaged: nested too deeply")
            if isinstance(event, yaml.AliasEvent):
                raise InputError(path, field, f"line {event.start_mark.line + 1}: aliases are not read")
            if count > _MAX_YAML_VALUES:
                raise InputError(path, field, f"is damaged: more than {_MAX_YAML_VALUES} values")
        return OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except InputError:
        raise
    except RecursionError:
        raise InputError(path, field, "is damaged: nested too deeply") from None
    except Exception as error:  # yaml and OmegaConf raise whatever the damage happens to be
        raise InputError(path, field, f"is damaged: {' '.join(str(error).split())}"[:200]) from None


#: What in a configuration makes Hydra and ``logging.config`` import and call things by name.
_CALLS = ("_target_", "()", "class", "ext://", "pkg://", "!!python")


def check_config_folder(folder: Path) -> None:
    """A folder of configuration that does not belong to the project may set values and name nothing to be called.

    Hydra calls what ``hydra.callbacks``, launchers, sweepers and the logging set-up name, before this project's own
    code sees the configuration.

    Raises:
        InputError: a YAML file in it names something to call, or cannot be read (:func:`read_yaml`).
    """
    for count, path in enumerate(sorted([*folder.rglob("*.yaml"), *folder.rglob("*.yml")])):
        if count > _MAX_FILES:
            raise InputError(folder, "files", f"more than {_MAX_FILES}: this is no folder of configuration")
        waiting = [read_yaml(path, "configuration")]
        while waiting:
            value = waiting.pop()
            if isinstance(value, dict):
                waiting += [*value, *value.values()]
            elif isinstance(value, list):
                waiting += value
            elif isinstance(value, str) and (call := next((c for c in _CALLS if _names(value, c)), None)):
                cause = f"{call!r} names something to call; only the project's own configuration may"
                raise InputError(path, value[:60], cause)


def _names(value: str, call: str) -> bool:
    """Whether a word of a configuration holds ``call``; a key for its last part, ``hydra.x._target_``."""
    return call in value if call.endswith("//") or call.startswith("!!") else value.split(".")[-1] == call


def load_tensors(folder: Path, field: str) -> TensorDict:
    """A flat TensorDict mapped from a folder that was looked through first (:func:`check_tensors`).

    Raises:
        InputError: as :func:`check_tensors`, or the tensors do not fit together.
    """
    check_tensors(folder, field)
    try:
        return TensorDict.load_memmap(folder, allow_pickle=False)
    except Exception as error:  # tensordict raises whatever the damage happens to be
        raise InputError(folder, field, f"is damaged: {error}"[:300]) from None


def check_tensors(folder: Path, field: str) -> None:
    """A folder of ``meta.json`` and ``*.memmap`` must hold plain tensors, each as long as it says, and nothing else.

    A file that was cut off would be mapped with zeros at its end in silence, one that is a link would let the owner of
    the folder have other files written to; pickles and classes other than TensorDict run code or import it. Other JSON
    files may stand beside them.

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
        if count > _MAX_FILES:
            raise InputError(folder, "files", f"more than {_MAX_FILES}: this is no checkpoint")
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


#: The largest networks, pictures and pools that a configuration in a checkpoint may ask for; ours are a tenth of it.
_MAX_SETTINGS = {
    **dict.fromkeys(("hidden", "hidden_size", "context_size", "features"), 2048),
    **dict.fromkeys(("channels", "input_size"), 512),
    **dict.fromkeys(("size", "working_size", "stored_size"), 1024),
    **dict.fromkeys(("workers", "threads", "physics_threads", "update_threads"), 1024),
    **dict.fromkeys(("encode_batch", "padding", "horizon"), 2**16),
}
_MAX_LAYERS = 8
_MAX_ENCODER_WEIGHTS = 2**28


def check_sizes(config: Any, source: Path) -> None:
    """A stranger's configuration must not ask for networks that fill the memory before their weights are looked at.

    Raises:
        InputError: a width, a number of layers, a picture or a pool of workers beyond any use; names the key.
    """
    waiting = [config]
    while waiting:
        value = waiting.pop()
        if isinstance(value, list):
            waiting += value
        if not isinstance(value, dict):
            continue
        waiting += value.values()
        for key, limit in _MAX_SETTINGS.items():
            sizes = value.get(key)
            numbers = [n for n in (sizes if isinstance(sizes, list) else [sizes]) if isinstance(n, int | float)]
            if len(numbers) > _MAX_LAYERS or any(not n <= limit for n in numbers):
                raise InputError(source, key, f"{str(sizes)[:60]}: at most {limit}, and {_MAX_LAYERS} in a row")
        side, features, channels = (value.get(k) for k in ("input_size", "features", "channels"))
        if isinstance(side, int) and isinstance(features, int):
            last = max([1, *(c for c in channels if isinstance(c, int))]) if isinstance(channels, list) else 1
            if side * side * last * features > _MAX_ENCODER_WEIGHTS:
                raise InputError(
                    source, "input_size", f"{side}, with {last} channels and {features} features: too large"
                )
