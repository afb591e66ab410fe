"""Words of ``egopose bench``: settings may be given as options, too."""

from __future__ import annotations

from collections.abc import Sequence

#: Options that the parser knows itself; its verb comes first.
OWN = ("--json", "--rounds", "--help")


def as_settings(words: Sequence[str]) -> list[str]:
    """The words with ``--key a b`` put as ``key=a,b`` and ``--key`` alone as ``key=true``, but for the parser's own."""
    out: list[str] = []
    taking = False
    for word in words:
        name, equals, value = word.partition("=")
        if name.startswith("--") and name not in OWN:
            out.append(f"{name[2:].replace('-', '_')}={value if equals else 'true'}")
            taking = not equals
        elif taking and not word.startswith("-") and not equals:
            out[-1] = f"{out[-1]},{word}" if not out[-1].endswith("=true") else f"{out[-1][:-4]}{word}"
        else:
            out.append(word)
            taking = False
    return out
