"""Windows of a clip by its boxes, and what carries a body."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from egopose.scene.carriers import carriers
from egopose.scene.scene_file import EFFECTORS, Contact
from egopose.scene.windows import Visit, Window, visits, windows

EFFECTOR, FRAME = st.sampled_from(EFFECTORS), st.integers(0, 80)


def contact(touches: str, first: int, last: int, effector: str = "left_foot") -> Contact:
    return Contact(effector, touches, first, last)


PATH = (
    contact("floor", 0, 9),
    contact("a", 12, 20),
    contact("a", 15, 26, "right_foot"),
    contact("b", 24, 40),
    contact("a", 44, 50),
    contact("c", 55, 60),
    contact("floor", 66, 79),
)


def test_visits_join_the_contacts_with_one_box() -> None:
    assert visits(PATH) == (Visit("a", 12, 26), Visit("b", 24, 40), Visit("a", 44, 50), Visit("c", 55, 60))


def test_windows_go_from_contact_to_contact_with_a_box_on_either_side() -> None:
    assert windows(PATH, 80) == (
        Window(1, ("a", "b"), 0, 12, 41),
        Window(2, ("a", "b"), 12, 24, 51),  # the box before is the box after
        Window(3, ("b", "a", "c"), 24, 44, 80),
        Window(4, ("a", "c"), 44, 80, 80),
    )


def test_a_clip_without_boxes_is_one_window() -> None:
    assert windows(PATH[:1], 30) == (Window(1, (), 0, 30, 30),)


@given(st.lists(st.tuples(st.sampled_from(["floor", *"abc"]), FRAME, st.integers(0, 15), EFFECTOR), max_size=9))
def test_policies_cover_a_clip_one_after_the_other(rows: list[tuple[str, int, int, str]]) -> None:
    there = windows([contact(what, first, first + more, who) for what, first, more, who in rows], 100)
    assert (there[0].start, there[-1].hand_over) == (0, 100)
    assert all(len(window.boxes) <= 3 for window in there)
    for before, after in pairwise(there):
        assert after.number == before.number + 1
        # Windows overlap: the next policy takes over where this one has been trained as well.
        assert after.hand_over == 100 or before.start <= before.hand_over <= after.hand_over
        assert before.stop >= before.hand_over


def test_what_carries_a_body() -> None:
    """Floor, then the left foot on box 1 while the right is still on the floor, in the air, on box 0, and back."""
    touches = np.zeros((8, 2, 3), dtype=bool)
    touches[0:3, 0, 0] = touches[2:4, 1, 2] = touches[5, 0, 1] = touches[7, 1, 0] = True
    assert carriers(touches).tolist() == [-1, -1, -1, 1, 1, 0, 0, -1]
