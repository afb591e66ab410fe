"""Safe readers of untrusted files: JSON, YAML and folders of tensors cannot run code and stay small.

A folder of memory-mapped tensors is more than tensors: its ``meta.json`` names the class to build, and what TensorDict
cannot map it reads from a pickle beside it. Here a folder is looked through first and all but plain tensors refused.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf

from egopose.core.errors import InputError

MAX_FILES = 20_000
#: The largest JSON or YAML read, bytes: as Python objects it takes up to some forty times as much.
MAX_JSON_BYTES = 16 * 2**20
MAX_YAML_BYTES = 2**18
_MAX_YAML_VALUES = 50_000
_MAX_YAML_DEPTH = 50


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
        if count > MAX_FILES:
            raise InputError(folder, "files", f"more than {MAX_FILES}: this is no folder of configuration")
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
    """An untrusted configuration must not ask for networks that fill the memory before their weights are read.

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
