"""Where the configuration lies, and typed reading of it with errors that name file and field."""

from __future__ import annotations

import difflib
import os
import re
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields
from datetime import datetime
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar, Union

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from egopose.core.config_files import config_dir, setting_names
from egopose.core.errors import InputError
from egopose.core.former_names import RENAMED
from egopose.core.path_settings import check_paths, check_run_directory
from egopose.core.safe_io import check_config_folder

T = TypeVar("T")


def resolved(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain containers, every interpolation replaced.

    Raises:
        InputError: a value is missing (``???``) or an interpolation leads nowhere; names the field.
    """
    try:
        out = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        field = str(getattr(error, "full_key", "") or "?")
        if isinstance(error, MissingMandatoryValue):
            raise InputError("command line", field, f"is missing; give {field}=...") from None
        raise InputError("configuration", field, str(error).splitlines()[0]) from None
    if not isinstance(out, dict):
        raise InputError("configuration", "top level", "must be a mapping")
    return {str(key): value for key, value in out.items()}


def from_mapping(cls: type[T], values: Mapping[str, Any], source: str) -> T:
    """Fill the dataclass ``cls`` from ``values``, converting numbers and lists to the annotated types.

    ``...`` as a value counts as absent.

    Raises:
        InputError: a key is missing, unknown, or its value is of another kind; names ``source`` and key.
    """
    hints = typing.get_type_hints(cls)
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    if unknown := set(values) - set(known):
        raise InputError(source, sorted(unknown)[0], f"is not a setting; there are {', '.join(known)}")
    out = {}
    for name, field in known.items():
        value = values.get(name, ...)
        if value is ...:
            if field.default is MISSING and field.default_factory is MISSING:
                raise InputError(source, name, "is missing")
            continue
        out[name] = convert(value, hints[name], source, name)
    return cls(**out)


def convert(value: Any, kind: Any, source: str, field: str) -> Any:
    """``value`` as ``kind``: bool, int, float, str, tuples of them, mappings from str to them, any of them optional.

    Raises:
        InputError: it is something else; names ``source`` and ``field``.
    """
    origin = typing.get_origin(kind)
    if origin in (Union, types.UnionType):
        options = [option for option in typing.get_args(kind) if option is not type(None)]
        if value is None and len(options) < len(typing.get_args(kind)):
            return None
        return convert(value, options[0], source, field)
    if origin is tuple:
        parts = typing.get_args(kind)
        if not isinstance(value, (list, tuple)):
            raise InputError(source, field, f"must be a list, not {value!r}")
        if parts[-1] is Ellipsis:
            parts = (parts[0],) * len(value)
        if len(parts) != len(value):
            raise InputError(source, field, f"must be {len(parts)} values, not {len(value)}")
        return tuple(convert(v, p, source, field) for v, p in zip(value, parts, strict=True))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise InputError(source, field, f"must be a mapping, not {value!r}")
        kept = typing.get_args(kind)[1]
        return {str(key): convert(one, kept, source, f"{field}.{key}") for key, one in value.items()}
    if kind is Any:
        return value
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    raise InputError(source, field, f"must be {kind.__name__}, not {value!r}")


def compose_config(name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The resolved ``conf/NAME.yaml`` with overrides as on a command line, outside Hydra's main or within it.

    Raises:
        InputError: an override names no setting or choice, or a value is missing.
    """
    register_resolvers()
    try:
        return resolved(_composed(name, tuple(overrides)))
    except HydraException as error:
        raise explained(name, error) from None


@lru_cache(maxsize=128)
def _composed(name: str, overrides: tuple[str, ...]) -> DictConfig:
    """Not resolved, and not to be changed. Hydra takes 0.2 s for it, and commands ask for the same again."""
    # Hydra's main has initialised its one instance, and a second one is refused.
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            return compose(name, list(overrides))
    finally:
        GlobalHydra.instance().hydra = running


def explained(name: str, error: HydraException) -> InputError:
    """What Hydra says of a command line for ``conf/NAME.yaml``, in one line that says what to do."""
    said = str(error)
    source = f"conf/{name}.yaml"
    if key := re.search(r"Could not override '([^']+)'", said):
        if key[1] in RENAMED:
            return InputError(source, key[1], f"is now called {RENAMED[key[1]]}")
        near = difflib.get_close_matches(key[1], setting_names(name), 1, 0.8)
        meant = f"; did you mean {near[0]}?" if near else ""
        return InputError(
            source, key[1], f"is not a setting{meant or f'; the file lists them: {config_dir() / name}.yaml'}"
        )
    if choice := re.search(r"Could not find '([^']+)/([^'/]+)'", said):
        # Hydra lists them, those of --config-dir too, and after them where it looked.
        _, _, listed = said.partition("Available options in")
        there = [line.strip() for line in listed.partition("Config search path")[0].splitlines() if line[:1] == "\t"]
        cause = f"there is no {choice[2]!r}; there are {', '.join(there) or 'none'}"
        return InputError(source, choice[1], f"{cause} (and your own: --config-dir DIR)")
    if isinstance(error, OverrideParseException):
        cause = "cannot be read: settings are given as key=value, quoted where the shell needs it"
        return InputError(source, error.override, cause)
    return InputError(source, "override", said.splitlines()[0])


def check_arguments(arguments: Sequence[str]) -> None:
    """To be called before Hydra's main reads a command line that may bring an untrusted configuration.

    Raises:
        InputError: ``--config-dir``, ``--config-path`` or a ``file://`` search path holds configuration that names
            something to call; a rerun from a pickle.
    """
    given, rest = get_args_parser().parse_known_args(list(arguments))
    if given.experimental_rerun is not None:
        raise InputError(given.experimental_rerun, "--experimental-rerun", "is a pickle, and no pickle is ever read")
    words = [*given.overrides, *rest]
    folders = [given.config_dir, given.config_path, *re.findall(r"file://([^,\]'\"]+)", " ".join(words))]
    if given.config_name:
        folders.append(str((config_dir() / given.config_name).parent))
    for folder in folders:
        if folder and Path(folder).is_dir() and Path(folder).resolve() != config_dir().resolve():
            check_config_folder(Path(folder))


@contextmanager
def faults_told(name: str) -> Iterator[None]:
    """For a main on ``conf/NAME.yaml``: what was given wrong ends in one line and exit code 2."""
    # Hydra itself would print a page on a slip of the pen, and of a fault of ours hide where it is.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        yield
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except HydraException as error:
        print(f"error: {explained(name, error)}", file=sys.stderr)
        raise SystemExit(2) from None


def command(name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """``hydra.main`` on ``conf/NAME.yaml`` behind :func:`check_arguments` and
    :func:`~egopose.core.path_settings.check_paths`; what was given wrong ends in one line.
    """

    def decorate(function: Callable[[DictConfig], None]) -> Callable[[], None]:
        @wraps(function)
        def checked(config: DictConfig) -> None:
            # Within Hydra's call: an exception that leaves it has a line of Hydra's before it.
            with faults_told(name):
                check_paths(name, config)
                function(config)

        entry = hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)(checked)

        @wraps(function)
        def main() -> None:
            with faults_told(name):
                check_arguments(sys.argv[1:])
                check_run_directory(sys.argv[1:])
                entry()

        return main

    return decorate


def register_resolvers() -> None:
    """``${run_directory:output,resume}`` for Hydra's run directory; may be called again."""
    OmegaConf.register_new_resolver("run_directory", run_directory, replace=True, use_cache=True)


def run_directory(output: str, resume: str | None) -> str:
    """The directory being resumed, or one under ``output`` named after the time that is not there yet."""
    if resume:
        return str(resume)
    first = Path(output) / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder, number = first, 2
    while folder.exists():
        folder, number = first.with_name(f"{first.name}_{number}"), number + 1
    return str(folder)
