"""What a reader or a step of preparation did that its user should know: sentences in a motion's ``meta["notes"]``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from egopose.motion.motion import Motion

#: Of a clip from elsewhere no more is repeated than this.
_MOST, _LONGEST = 20, 300


def notes_of(motion: Motion) -> tuple[str, ...]:
    """The notes, oldest first; of a clip that came as a file, only what is text, and in single lines."""
    notes = motion.meta.get("notes")
    if not isinstance(notes, list | tuple):
        return ()
    return tuple(" ".join(note.split())[:_LONGEST] for note in notes[:_MOST] if isinstance(note, str))


def with_note(motion: Motion, note: str) -> Motion:
    """The motion with one note more."""
    return replace(motion, meta={**motion.meta, "notes": [*notes_of(motion), note]})


def tell_notes(name: str, motion: Motion, tell: Callable[[str], object]) -> None:
    """Hand each note to ``tell`` in one line, behind the motion's name."""
    for note in notes_of(motion):
        tell(f"{name}: {note}")
