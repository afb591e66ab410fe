"""The command ``bench estimate``: the stages of the real command over a film's length."""

from __future__ import annotations

import json

import numpy as np
import pytest

from egopose import bench
from egopose.benchmarks import estimate


def test_stages_add_up_to_the_whole(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    texture = np.random.default_rng(0).integers(0, 255, (48, 128, 3)).astype(np.uint8)
    # Rendering 640 x 480 pictures takes longer than all that is tested here.
    monkeypatch.setattr(estimate, "_film", lambda: (texture[:, 2 * t : 2 * t + 64] for t in range(1000)))
    bench.main(["estimate", "--json", "--rounds", "1", "film.seconds=1", "size=64"])
    result = json.loads(capsys.readouterr().out)
    assert list(result["stages"]) == ["starting", "reading the film", "seeing the pose", "moving the body", "drawing"]
    assert sum(result["stages"].values()) == pytest.approx(result["real_time_factor"])
    assert min(result["stages"].values()) >= 0
    assert (result["film_seconds"], result["rounds"]) == (1.0, 1)
    assert result["processor_factor"] > 0.5  # no computer loads torch in half a second


@pytest.mark.parametrize("word", ["film.seconds=0", "film.secnds=9", "film.seconds=x", "chekpoint=none"])
def test_a_wrong_setting_is_one_line(word: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "_film", lambda: iter(np.zeros((40, 8, 8, 3), np.uint8)))
    with pytest.raises(SystemExit) as stop:
        bench.main(["estimate", "--json", word, "--rounds", "1"])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert word.partition("=")[0] in error
    assert len(error.splitlines()) == 1
