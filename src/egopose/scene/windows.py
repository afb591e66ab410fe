"""A clip in windows of up to three boxes, each with a policy of its own (Yu, Park & Lee 2021, section 5.3).

Policy n acts from the first contact with box n - 1 to that with box n; box 0 is where the clip begins. It is trained
until the contact with box n + 1 is over, so that it comes to box n in a way that goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from egopose.scene.scene_file import FLOOR, Contact


@dataclass(frozen=True)
class Visit:
    """A box that the body touches from frame ``first`` to frame ``last``, before it touches another."""

    box: str
    first: int
    last: int


@dataclass(frozen=True)
class Window:
    """What one policy is trained on and acts in.

    Args:
        number: from 1 on.
        boxes: names of the boxes of visits n - 1, n and n + 1, each once, as far as they are there.
        start: first frame: of the contact with box n - 1.
        hand_over: frame of the first contact with box n, in which the next policy takes over; of the last window one
            past the clip's last frame.
        stop: one past the last frame of training.
    """

    number: int
    boxes: tuple[str, ...]
    start: int
    hand_over: int
    stop: int


def visits(contacts: Sequence[Contact]) -> tuple[Visit, ...]:
    """The boxes touched one after the other; contacts with the floor do not count. A box may come more than once."""
    out: list[Visit] = []
    for contact in sorted(contacts, key=lambda one: (one.first, one.last)):
        if contact.touches == FLOOR:
            continue
        if out and out[-1].box == contact.touches:
            out[-1] = Visit(contact.touches, out[-1].first, max(out[-1].last, contact.last))
        else:
            out.append(Visit(contact.touches, contact.first, contact.last))
    return tuple(out)


def windows(contacts: Sequence[Contact], frames: int) -> tuple[Window, ...]:
    """The windows of a clip of so many frames; one of the whole clip where no box is touched."""
    seen = visits(contacts)
    if not seen:
        return (Window(1, (), 0, frames, frames),)
    out = []
    for n, visit in enumerate(seen):
        last = n == len(seen) - 1
        near = seen[max(0, n - 1) : n + 2]
        # What comes after the last visit belongs to the last two windows.
        stop = frames if n + 2 >= len(seen) else seen[n + 1].last + 1
        hand_over = frames if last else visit.first
        start = 0 if n == 0 else seen[n - 1].first
        out.append(Window(n + 1, tuple(dict.fromkeys(v.box for v in near)), start, hand_over, stop))
    return tuple(out)
