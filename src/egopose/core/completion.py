"""``egopose completion bash|zsh``: the script that completes verbs, settings and choices in a shell.

The shell asks ``egopose completion words LINE`` for what can stand at the line's end; that reads ``conf/`` and imports
nothing heavy.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from egopose.core.config import config_dir
from egopose.core.verbs import BENCHMARKS, VERBS

_BASH = """\
# egopose: eval "$(egopose completion bash)"
_egopose() {
    local line="${COMP_LINE:0:COMP_POINT}"
    local word="${line##* }"
    COMPREPLY=()
    local one
    while IFS= read -r one; do COMPREPLY+=("$one"); done < <(egopose completion words "$line" 2>/dev/null)
    # Bash begins a new word after "=".
    case "$word" in *=*) COMPREPLY=("${COMPREPLY[@]#"${word%=*}="}") ;; esac
    case "${COMPREPLY[0]}" in *=|*.) compopt -o nospace ;; esac
}
complete -o default -F _egopose egopose
"""

_ZSH = """\
# egopose: eval "$(egopose completion zsh)"
_egopose() {
    local -a found
    found=("${(@f)$(egopose completion words "$LBUFFER" 2>/dev/null)}")
    if [[ -n "${found[1]}" ]]; then compadd -Q -S '' -- "${found[@]}"; else _files; fi
}
compdef _egopose egopose
"""

SCRIPTS = {"bash": _BASH, "zsh": _ZSH}

_PARSED = ("bench", "view")  # verbs with options in the manner of --port
_CONFIG = {"bench": "train", "demo": "train"}  # verbs whose settings stand in another's file
_MORE = {"demo": ("budget=",), "export": ("to=",)}  # words that stand in no file


def candidates(line: str, verbs: list[str]) -> list[str]:
    """What may stand in place of the last word of a command line; empty where a file name is to be completed.

    Args:
        line: from ``egopose`` to the cursor.
        verbs: the command's.
    """
    words = line.split(" ")
    verb, word = words[1] if len(words) > 1 else "", words[-1]
    if len(words) <= 2:
        return [v for v in verbs if v.startswith(verb)]
    if verb == "completion":
        return [shell for shell in SCRIPTS if shell.startswith(word)]
    if verb in _PARSED and word.startswith("-"):
        return [option for option in _options(verb) if option.startswith(word)]
    if verb == "bench":
        if not set(words[2:-1]) & set(BENCHMARKS):
            return [name for name in BENCHMARKS if name.startswith(word)]
    more = [key for key in _MORE.get(verb, ()) if key.startswith(word)]
    folder, verb = config_dir(), _CONFIG.get(verb, verb)
    if not (folder / f"{verb}.yaml").is_file():
        return []
    groups = _groups(folder, verb)
    key, given, value = word.partition("=")
    if given:
        choices = [path.stem for path in sorted((folder / key).glob("*.yaml"))] if key in groups else []
        return [f"{key}={choice}" for choice in choices if choice.startswith(value)]
    every = {f"{key}=" for key in groups} | set(_settings(folder, verb, groups))
    matching = [*more, *sorted(setting for setting in every if setting.startswith(word))]
    # As far as the next dot: the settings of a group are shown when it is named.
    return sorted({m[: m.find(".", len(word)) + 1] or m for m in matching})


def setting_names(verb: str) -> list[str]:
    """All settings and groups of ``conf/VERB.yaml``, as they are given on the command line."""
    folder = config_dir()
    groups = _groups(folder, verb)
    return sorted({*groups, *(key.rstrip("=") for key in _settings(folder, verb, groups))})


def _options(verb: str) -> list[str]:
    """Of a verb that reads its command with argparse."""
    parser = importlib.import_module(f"egopose.{verb}").command_line()
    return [option for action in parser._actions for option in action.option_strings if option.startswith("--")]


def _load(path: Path) -> dict[str, Any]:
    """One of the package's own files, interpolations as they stand."""
    values = yaml.safe_load(path.read_text())
    return {str(key): value for key, value in values.items()} if isinstance(values, dict) else {}


def _groups(folder: Path, verb: str) -> dict[str, str | None]:
    """Groups of a verb's configuration and the choice each has by default."""
    entries = [entry for entry in _load(folder / f"{verb}.yaml").get("defaults", []) if isinstance(entry, dict)]
    return {g: choice for entry in entries for g, choice in entry.items() if not g.startswith("override ")}


def _settings(folder: Path, verb: str, groups: dict[str, str | None]) -> Iterator[str]:
    """Every ``key=`` of the verb's own file and of its groups' choices."""
    yield from _keys(_load(folder / f"{verb}.yaml"), "")
    for group, choice in groups.items():
        yield from _choice(folder, group, f"{choice}", f"{group}.")


def _choice(folder: Path, group: str, choice: str, prefix: str) -> Iterator[str]:
    """Of one file of a group, and of those it builds on."""
    path = folder / group / f"{choice}.yaml"
    if not path.is_file():
        return
    values = _load(path)
    yield from _keys(values, prefix)
    for base in values.get("defaults", []):
        if isinstance(base, dict):  # {/group@package: choice}
            for name, chosen in base.items():
                other, _, package = name.lstrip("/").partition("@")
                yield from _choice(folder, other, str(chosen), f"{prefix}{package}.")
        elif base != "_self_":
            yield from _choice(folder, group, str(base), prefix)


def _keys(values: dict[str, Any], prefix: str) -> Iterator[str]:
    for key, value in values.items():
        if key in ("defaults", "hydra"):
            continue
        if isinstance(value, dict) and value:
            yield from _keys(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}="


def main() -> None:
    """Command line."""
    arguments = sys.argv[1:]
    if len(arguments) == 2 and arguments[0] == "words":
        print("\n".join(candidates(arguments[1], list(VERBS))))
    elif len(arguments) == 1 and arguments[0] in SCRIPTS:
        print(SCRIPTS[arguments[0]], end="")
    else:
        print('usage: eval "$(egopose completion bash)"    or zsh', file=sys.stderr)
        raise SystemExit(0 if arguments in (["-h"], ["--help"]) else 2)


if __name__ == "__main__":
    main()
