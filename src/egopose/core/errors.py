"""The one error a user sees for bad input: it names the file, the field (or line) and the cause."""

from __future__ import annotations

from os import PathLike


class InputError(ValueError):
    """Something the user handed in cannot be used.

    Args:
        source: the file, run directory or setting at fault.
        field: the field, line or key inside it (``"line 12"``, ``"Frames"``).
        cause: what is wrong and, where it can be said, what would be right.
    """

    def __init__(self, source: str | PathLike[str], field: str, cause: str) -> None:
        self.source, self.field, self.cause = str(source), field, cause
        super().__init__(f"{self.source}: {field}: {cause}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        # BaseException would rebuild it from its message alone, and a worker process could not hand it to its parent.
        return type(self), (self.source, self.field, self.cause)


class NoOpenGL(InputError, RuntimeError):
    """Nothing can be drawn on this machine as it is; says what to install or to set."""
