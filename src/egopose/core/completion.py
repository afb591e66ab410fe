"""``egopose completion bash|zsh``: the script that completes verbs, settings and choices in a shell.

The shell asks ``egopose completion words LINE`` for what can stand at the line's end; that reads ``conf/`` and imports
nothing heavy.
"""

from __future__ import annotations

import importlib
import sys

from egopose.core.config_files import _groups, _settings, config_dir
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
_MORE = {"demo": ("train=", "budget="), "export": ("to=",)}  # words that stand in no file


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
    if verb == "bench" and not set(words[2:-1]) & set(BENCHMARKS):
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


def _options(verb: str) -> list[str]:
    """Of a verb that reads its command with argparse."""
    parser = importlib.import_module(f"egopose.{verb}").command_line()
    return [option for action in parser._actions for option in action.option_strings if option.startswith("--")]


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
