"""``egopose VERB [key=value ...]``: one command, a verb for each main; ``python -m egopose.VERB`` is the same."""

from __future__ import annotations

import difflib
import importlib
import sys
from importlib.metadata import version

from egopose.core.verbs import FORMER, VERBS


def usage() -> str:
    """The help text."""
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {verb.ljust(width)}  {what}" for verb, what in VERBS.items())
    more = '`egopose VERB --help` explains a verb; eval "$(egopose completion bash)" lets the shell complete them.'
    return f"usage: egopose VERB [key=value ...]\n       egopose --version\n\n{verbs}\n\n{more}"


def main() -> None:
    """Run the verb's own main, with the remaining arguments as its command line."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        raise SystemExit(0 if arguments else 2)
    if arguments[0] == "--version":
        print(f"egopose {version('egopose')}")
        raise SystemExit(0)
    verb = FORMER.get(arguments[0], arguments[0])
    if verb not in VERBS:
        near = difflib.get_close_matches(verb, VERBS, 1)
        meant = f"; did you mean {near[0]}?" if near else ""
        print(f"error: no verb {verb!r}{meant}\n\n{usage()}", file=sys.stderr)
        raise SystemExit(2)
    sys.argv = [f"egopose {verb}", *arguments[1:]]
    module = "core.completion" if verb == "completion" else verb
    importlib.import_module(f"egopose.{module}").main()


if __name__ == "__main__":
    main()
