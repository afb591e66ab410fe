"""Progress over stages: frames told, the bar, and the lines where there is no terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from egopose.inference.progress import StageProgress, stage_seconds

STAGES = {"reading": 1.0, "moving the body": 3.0}


def progress(terminal: bool) -> tuple[StageProgress, io.StringIO]:
    out = io.StringIO()
    return StageProgress(STAGES, 10, Console(file=out, force_terminal=terminal, width=100)), out


def share(told: StageProgress) -> float:
    task = told._bar.tasks[0]
    assert task.total is not None
    return task.completed / task.total


def test_stages_fill_the_bar_by_what_they_cost() -> None:
    told, out = progress(terminal=True)
    with told:
        with told.stage("reading") as advance:
            advance(5)
            assert share(told) == pytest.approx(5 / 40)
        assert share(told) == pytest.approx(0.25)
        with told.stage("moving the body") as advance:
            advance(4)
            assert share(told) == pytest.approx((10 + 12) / 40)
            advance(100)  # a header may announce fewer frames than there are
            assert share(told) == 1.0
    assert "moving the body" in out.getvalue()
    assert "100%" in out.getvalue()
    assert set(told.seconds) == set(STAGES)


def test_without_a_terminal_a_stage_is_one_line() -> None:
    told, out = progress(terminal=False)
    with told:
        for name in STAGES:
            with told.stage(name) as advance:
                advance(10)
    lines = out.getvalue().splitlines()
    assert [line.partition(":")[0] for line in lines] == list(STAGES)
    read = stage_seconds(f"warning: nothing: 3\n{out.getvalue()}450 frames, 3 resets\n")
    assert list(read) == list(STAGES)
    assert read == pytest.approx(told.seconds, abs=0.006)


def test_a_stage_that_fails_leaves_no_line() -> None:
    told, out = progress(terminal=False)
    with pytest.raises(KeyError), told, told.stage("reading"):
        raise KeyError
    assert not out.getvalue()
    assert not told.seconds
