"""The command ``bench env``."""

from __future__ import annotations

import json

import pytest

from egopose import bench


def test_a_wrong_setting_is_one_line(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        bench.main(["env", "--json", "collector.wrlds=3"])
    assert stop.value.code == 2
    assert "wrlds" in capsys.readouterr().err


@pytest.mark.slow
def test_the_full_loop_keeps_most_of_mujocos_speed(capsys) -> None:
    bench.main(["env", "--json", "--rounds", "5"])
    result = json.loads(capsys.readouterr().out)
    assert result["substeps"] == 15
    assert result["num_envs"] == 64
    assert result["ratio"] > 0.6  # 0.70 is the aim; a busy machine takes some
