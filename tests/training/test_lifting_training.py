"""Training the lifting network: what is drawn, that it learns, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.mocap import default_humanoid, hold_out_the_turn
from helpers.walking import walking
from torch import Tensor

from egopose.checkpoint.lifting import load_lifting_network
from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.pipeline.lifting import train_lifter
from egopose.scene.lifting import JOINTS, KEYPOINTS, SEEN, WINDOW
from egopose.training.lifting_data import SightSettings, body_offsets, draw_windows, joint_parents, joint_turns
from egopose.training.lifting_network import LifterSettings, lifting_errors, train_lifting_network

EXACT: dict[str, Any] = {
    **{"error": (0.0, 0.0), "dropped": 0.0, "hidden": 0.0, "no_feet": 0.0, "swapped": 0.0},
    **{"length_error": 0.0, "mixed": 0.0, "distance": (1e5, 1e5)},
}


@lru_cache
def shipped() -> tuple[SightSettings, LifterSettings]:
    values = compose_config("lifter", ["out=x"])
    sight = from_mapping(SightSettings, values["sight"], "conf")
    return sight, from_mapping(LifterSettings, values["training"], "conf")


def drawn(sight: SightSettings, repeats: int = 4) -> tuple[Tensor, Tensor]:
    """Windows ``[N, 9, K, 3]`` and points ``[N, 28, 3]`` of a walk."""
    turns, humanoid = joint_turns([walking()]), default_humanoid()
    random = torch.Generator().manual_seed(0)
    offsets, parents = body_offsets(humanoid, sight), joint_parents(humanoid.skeleton)
    windows, points = draw_windows(turns, turns.middles.repeat(repeats), offsets, parents, sight, random)
    return windows.unflatten(-1, (WINDOW, len(KEYPOINTS), 3)), points


def scales(windows: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Body heights per unit of each window, and how far its keypoints then lie from the points, body heights."""
    middle, flat = windows[:, WINDOW // 2], points[:, list(SEEN), :2]
    seen = (middle[..., 2:] > 0).float()
    scale = (middle[..., :2] * flat * seen).sum((1, 2)) / (middle[..., :2] ** 2 * seen).sum((1, 2))
    off = ((scale[:, None, None] * middle[..., :2] - flat) * seen).norm(dim=-1).sum(1) / seen.sum((1, 2))
    return scale, off


def test_a_far_camera_without_errors_sees_the_points_themselves() -> None:
    sight = replace(shipped()[0], **EXACT)
    windows, points = drawn(sight)
    assert float(scales(windows, points)[1].max()) < 1e-4
    lengths = (points[:, JOINTS.index("LeftLeg")] - points[:, JOINTS.index("LeftFoot")]).norm(dim=-1)
    torch.testing.assert_close(lengths, torch.full_like(lengths, sight.lengths["LeftFoot"]))
    hips = points[:, [JOINTS.index("LeftUpLeg"), JOINTS.index("RightUpLeg")]].mean(dim=1)
    assert float(hips.abs().max()) < 1e-6
    assert (points[:, JOINTS.index("Head"), 1] < 0).float().mean() > 0.95  # y points down


def test_keypoints_are_as_wrong_as_asked() -> None:
    for level in (0.01, 0.03):
        sight = replace(shipped()[0], **{**EXACT, "error": (level, level)}, definition=0.0)
        off = scales(*drawn(sight, 8))[1]
        assert float(off.mean()) == pytest.approx(level, rel=0.4)


def test_shares_of_faults_are_those_asked_for() -> None:
    sight = replace(shipped()[0], **{**EXACT, "no_feet": 0.5, "dropped": 0.1})
    windows, _ = drawn(sight, 20)
    unseen = windows[..., 2] == 0
    feet = [KEYPOINTS.index("left_heel"), KEYPOINTS.index("right_big_toe")]
    assert 0.4 < float(unseen[:, :, feet].all(dim=1).all(dim=1).float().mean()) < 0.6
    assert 0.08 < float(unseen[:, :, KEYPOINTS.index("left_wrist")].float().mean()) < 0.12
    assert not windows[..., :2][unseen].any()
    # An exchange moves keypoints onto their twins: without one they lie where the points are.
    off = scales(*drawn(replace(shipped()[0], **{**EXACT, "swapped": 1.0}), 20))[1]
    assert 0.1 < float((off > 0.01).float().mean()) < 0.6


def test_it_learns_a_walk_and_is_the_same_each_time() -> None:
    sight, settings = shipped()
    simple = replace(settings, width=64, blocks=1, epochs=30, uses=4, batch=32, bfloat16=False, learning_rate=0.01)
    told: list[float] = []
    network = train_lifting_network(
        default_humanoid(), [walking()] * 4, sight, simple, lambda epoch, loss, seconds: told.append(loss)
    )
    assert told[-1] < 0.6 * told[0]
    errors = lifting_errors(network, default_humanoid(), [walking()], sight, 1)
    assert errors["network"] < 0.7 * errors["mean pose"]
    few = replace(simple, epochs=1)
    one, other = (train_lifting_network(default_humanoid(), [walking()], sight, few).state_dict() for _ in range(2))
    assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    ("changed", "name"),
    [({"lengths": {"Tail": 1.0}}, "Tail"), ({"lasting": 0.8}, "lasting"), ({"distance": (0.5, 2.0)}, "distance")],
)
def test_settings_that_cannot_be_are_refused(changed: dict[str, Any], name: str) -> None:
    with pytest.raises(InputError, match=name):
        replace(shipped()[0], **changed)
    with pytest.raises(InputError, match="width"):
        replace(shipped()[1], width=0)


def test_the_command_trains_judges_and_saves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hold_out_the_turn(tmp_path, monkeypatch)
    out = tmp_path / "lifter"
    words = [f"sources.cmu6={tmp_path / 'mocap'}", "whole=[]", f"out={out}", "training.width=16"]
    values = compose_config("lifter", [*words, "training.epochs=1", "training.batch=8", "training.bfloat16=false"])
    train_lifter(values)
    assert "held-out people: network" in capsys.readouterr().out
    result = json.loads((out / "result.json").read_text())
    assert 0 < result["mm"]["network"] < 2000
    assert not load_lifting_network(out / "network").training
    with pytest.raises(InputError, match="is there already"):
        train_lifter(values)
    with pytest.raises(InputError, match="config-name lifter"):
        load_lifting_network(tmp_path / "none")
