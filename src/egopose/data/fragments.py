"""Where episodes start: pieces of takes, drawn or dealt out."""

from __future__ import annotations

from typing import Protocol


class FragmentLike(Protocol):
    """Frames ``start`` to ``stop`` (exclusive) of take number ``take``, counted within the take."""

    @property
    def take(self) -> int: ...
    @property
    def start(self) -> int: ...
    @property
    def stop(self) -> int: ...
