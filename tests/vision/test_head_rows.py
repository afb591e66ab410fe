"""Rows of a film in order, though several threads make them; frames that a slower film lacks repeat the last row."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egopose.vision.head_film import head_rows
from egopose.vision.lens import Camera
from egopose.vision.video import write_video

FIELD = Camera(field_of_view=90.0)


def test_rows_are_in_order_and_a_slower_film_repeats_them(tmp_path: Path) -> None:
    texture = np.random.default_rng(0).integers(0, 255, (12, 60, 3)).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    moves = np.cumsum(np.arange(12) % 5)  # pixels: each step's flow is another
    write_video(tmp_path / "pan.mp4", [texture[:, at : at + 128] for at in moves], 15.0)
    shown: list[int] = []
    rows = list(head_rows(tmp_path / "pan.mp4", 15.0, 0.0, FIELD, None, lambda frame: shown.append(frame.shape[1])))
    assert shown == [128] * 12
    assert [row.time for row in rows] == sorted(row.time for row in rows)
    across = [float(np.nanmedian(row.flow[0, 1:-1, 4:-4])) * 128 for row in rows]
    np.testing.assert_allclose(across[1:], -np.diff(moves), atol=0.6)

    slow = list(head_rows(tmp_path / "pan.mp4", 30.0, 0.0, FIELD, None))
    times = np.array([row.time for row in slow])
    assert len(np.unique(times)) == 12
    for time in np.unique(times):
        same = [row for row in slow if row.time == time]
        np.testing.assert_array_equal(same[0].flow, same[-1].flow)
    np.testing.assert_array_equal(slow[-1].flow, rows[-1].flow)
