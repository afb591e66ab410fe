"""Training of the regressor of head signals: what is drawn, what film adds, and that it learns the same each time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.mocap import default_humanoid, hold_out_the_turn
from helpers.walking import walking

from egopose.checkpoint.head_signal import load_head_signal_regressor, save_head_signal_regressor
from egopose.core.config import compose_config, convert, from_mapping
from egopose.core.errors import InputError
from egopose.evaluation.metrics import pose_error
from egopose.models.mirror import state_mirror
from egopose.models.pose_regression import integrated_path, state_to_qpos
from egopose.models.regressor import StateRegressor
from egopose.motion import rotations as rot
from egopose.motion.rotations import Array
from egopose.pipeline.head_signal import make_head_signal_regressor, motions_of, train_head_signal
from egopose.training.head_signal_figures import held_out_figures
from egopose.training.head_signal_regressor import (
    HeadSignalSettings,
    as_filmed,
    draw_examples,
    exact_example,
    paced,
    slow,
    still_example,
    train_head_signal_regressor,
)
from egopose.vision.mounts import mount_of

FPS = 30.0
TINY = {"variants": 1, "length": 8, "batch": 2, "epochs": 2, "context_size": 8, "hidden": (16,), "learning_rate": 0.01}


def shipped() -> HeadSignalSettings:
    return from_mapping(HeadSignalSettings, compose_config("head_signal", ["out=x"])["training"], "conf")


def tiny(**changed: Any) -> HeadSignalSettings:
    return replace(shipped(), **{**TINY, **changed})


def curve(count: int = 61) -> Array:
    """qpos of a root that goes and turns at constant rates, with one joint that bends."""
    times = np.arange(count) / FPS
    turn = rot.from_axis_angle(np.array([0.0, 0.0, 1.0]), 0.8 * times)
    return np.column_stack([1.2 * times, 0.3 * times, np.full(count, 0.95), turn, 0.5 * times])


@pytest.mark.parametrize("pace", [0.7, 1.0, 1.3])
def test_another_pace_scales_velocities_and_keeps_the_way(pace: float) -> None:
    own = curve()
    other = paced(own, pace)
    assert len(other) == int(60 / pace) + 1
    np.testing.assert_allclose(np.diff(other[:, :2], axis=0) * FPS, [[1.2 * pace, 0.3 * pace]] * (len(other) - 1))
    np.testing.assert_allclose(np.diff(other[:, 7]) * FPS, 0.5 * pace)
    turned = rot.to_rotvec(rot.multiply(rot.conjugate(other[:-1, 3:7]), other[1:, 3:7]))
    np.testing.assert_allclose(turned * FPS, [[0.0, 0.0, 0.8 * pace]] * len(turned), atol=1e-9)
    # Each frame lies on the line that the recorded frames make.
    np.testing.assert_allclose(other[:, 1], 0.25 * other[:, 0], atol=1e-12)
    np.testing.assert_allclose(other[-1, :2], own[-1, :2], atol=1.2 * pace / FPS)
    assert len(paced(own[:1], pace)) == 1


def test_examples_are_the_motions_own_states_and_signals() -> None:
    humanoid, clip = default_humanoid(), walking().qpos
    example = exact_example(humanoid, clip, FPS, mount_of("head", 0.0, 0.4, 0.0))
    assert example.features.shape == (len(clip), 13)
    assert example.features.dtype == example.states.dtype == torch.float32
    # The head goes where the root goes: 1 m/s or more, at 1.6 m of height.
    path = integrated_path(example.states.numpy(), FPS)
    speed = np.linalg.norm(path[-1, :2]) / (len(path) - 1) * FPS
    assert float(example.features[1:, 3].mean()) * 1.6 == pytest.approx(speed, rel=0.15)
    short = draw_examples(humanoid, [clip, clip[:5]], tiny(), np.random.default_rng(0))
    assert len(short) == 1


def test_film_adds_noise_and_says_how_much() -> None:
    features = torch.zeros(6, 90, 13)
    features[..., 3], features[..., 6], features[..., 8:10], features[..., 10] = 0.8, 0.4, 1.0, 1.0
    before = features.clone()
    seen = as_filmed(features, tiny(), torch.Generator().manual_seed(0))
    torch.testing.assert_close(features, before)
    assert seen.shape == features.shape
    assert ((seen[..., 8:10] >= 0) & (seen[..., 8:10] <= 1)).all()
    torch.testing.assert_close(seen[..., 10:], features[..., 10:])
    # The noisier a fragment's turns, the lower their quality.
    noise, quality = seen[..., 0:3].std(1).mean(1), seen[:, 0, 8]
    assert torch.corrcoef(torch.stack([noise, quality]))[0, 1] < -0.8
    clean = tiny(height_error=0.0, vertical_error=0.0, turn_noise=0.0, velocity_noise=0.0, unseen=0.0)
    exact = as_filmed(features, clean, torch.Generator().manual_seed(0))
    torch.testing.assert_close(exact[..., :8], features[..., :8])
    dark = as_filmed(features, replace(clean, unseen=1.0), torch.Generator().manual_seed(0))
    hidden = dark[..., 9] < 0.2
    assert hidden.any(1).all()
    assert (dark[..., 3][hidden] < 0.2).all()
    torch.testing.assert_close(dark[..., 3][~hidden], features[..., 3][~hidden])


def test_slow_noise_is_as_large_and_lasts() -> None:
    noise = slow(torch.randn(3000, 2, generator=torch.Generator().manual_seed(0)), 0.5)
    assert float(noise.std()) == pytest.approx(1.0, abs=0.15)
    neighbours = torch.corrcoef(torch.stack([noise[:-1, 0], noise[1:, 0]]))[0, 1]
    assert float(neighbours) == pytest.approx(np.exp(-1 / 15), abs=0.02)


def test_a_still_body_has_no_velocity() -> None:
    example = exact_example(default_humanoid(), walking().qpos, FPS, mount_of("head"))
    still = still_example(example, 3, 50, torch.Generator().manual_seed(0))
    dofs = (example.states.shape[1] - 11) // 2
    assert still.states.shape == (50, example.states.shape[1])
    assert not still.states[:, 5 + dofs :].any()
    torch.testing.assert_close(still.states[7, : 5 + dofs], example.states[3, : 5 + dofs])
    assert 0 < still.features[:, :6].abs().max() < 0.1


def test_two_epochs_learn_and_are_the_same_each_time() -> None:
    clips = [walking().qpos] * 24
    few = tiny(batch=4, still=0.0, turn_noise=0.0, velocity_noise=0.0, dropout=0.0)
    told: list[list[float]] = [[], []]
    models = [
        train_head_signal_regressor(default_humanoid(), clips, few, lambda e, loss, s, k=k: told[k].append(loss))
        for k in range(2)
    ]
    assert told[0] == told[1]
    assert told[0][1] < told[0][0]
    one, other = (model.state_dict() for model in models)
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not models[0].training
    different = train_head_signal_regressor(default_humanoid(), clips[:2], replace(few, epochs=1, seed=1))
    assert not torch.equal(different.state_dict()["state_mean"], one["state_mean"])


def test_what_cannot_be_learned_from_is_refused() -> None:
    with pytest.raises(InputError, match="takes"):
        train_head_signal_regressor(default_humanoid(), [walking().qpos[:4]], tiny())
    for changed, name in (
        ({"mounts": {"knee": 1.0}}, "knee"),
        ({"mounts": {"head": 0.0}}, "mounts"),
        ({"batch": 0}, "batch"),
    ):
        with pytest.raises(InputError, match=name):
            tiny(**changed)
    with pytest.raises(InputError, match="mapping"):
        convert([1.0], dict[str, float], "conf", "mounts")
    with pytest.raises(InputError, match=r"mounts\.head"):
        convert({"head": "much"}, dict[str, float], "conf", "mounts")


def test_figures_are_the_papers() -> None:
    """A regressor that always gives one pose has that pose's E_pose, and the mean's error is 1."""
    humanoid, clip = default_humanoid(), walking().qpos
    example = exact_example(humanoid, clip, FPS, mount_of("head", 0.0, 0.4, 0.0))
    mean = example.states.mean(0)
    model = StateRegressor(None, mean, torch.ones_like(mean), 13, 4, (4,))
    for weight in model.head.parameters():
        torch.nn.init.zeros_(weight)
    figures = held_out_figures(model.eval(), humanoid, [clip], ["head"], 23.0)["head"]
    where, heading = clip[:, :2], rot.heading(clip[:, 3:7])
    states = np.tile(mean.numpy().astype(float), (len(clip), 1))
    estimate, _ = state_to_qpos(states, where, heading, humanoid.joint_range)
    expected = pose_error(estimate, clip, [int(d) for d in humanoid.hand_dofs]).mean()
    assert figures["E_pose"] == pytest.approx(expected, rel=2e-3)
    assert figures["E_pose of the mean"] == pytest.approx(figures["E_pose"])
    assert figures["error"] == pytest.approx(1.0)


def test_the_mirror_of_a_motion_gives_the_mirror_of_its_example() -> None:
    """Features and states are mirrored together in training: a walk and its mirror image are one body's."""
    humanoid, clip = default_humanoid(), walking().qpos
    states = exact_example(humanoid, clip, FPS, mount_of("head")).states
    mirror = state_mirror(humanoid.skeleton)
    torch.testing.assert_close(mirror.state(mirror.state(states)), states)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The command's configuration with one source, two short embedded clips; one of them is a test person's."""
    hold_out_the_turn(tmp_path, monkeypatch)
    training = [f"training.{name}={list(v) if isinstance(v, tuple) else v!s}" for name, v in TINY.items()]
    source = [f"sources.cmu6={tmp_path / 'mocap'}", "whole=[]", f"out={tmp_path / 'regressor'}"]
    return compose_config("head_signal", [*source, *training])


def test_the_command_holds_people_out_saves_and_does_not_overwrite(
    small: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train, test = motions_of(small)
    assert (len(train), len(test)) == (1, 1)
    assert [len(part) for part in motions_of({**small, "whole": ["cmu6"]})] == [2, 0]
    train_head_signal(small)
    told = capsys.readouterr()
    assert "epoch 2 of 2" in told.err
    assert "head: E_pose" in told.out
    saved = load_head_signal_regressor(default_humanoid(), tmp_path / "regressor")
    figures = held_out_figures(saved, default_humanoid(), test, ["chest"], 22.5)["chest"]
    assert f"chest: E_pose {figures['E_pose']:.3f}" in told.out
    with pytest.raises(InputError, match="is there already"):
        make_head_signal_regressor(small)
    with pytest.raises(InputError, match="sources"):
        motions_of({**small, "sources": {"cmu6": None}})
    with pytest.raises(InputError, match="whole"):
        motions_of({**small, "whole": ["cmu7"]})


def test_a_saved_regressor_is_the_same_and_knows_its_skeleton(tmp_path: Path) -> None:
    humanoid = default_humanoid()
    settings = tiny(epochs=1)
    model = train_head_signal_regressor(humanoid, [walking().qpos], settings)
    save_head_signal_regressor(model, humanoid, settings, tmp_path / "one")
    again = load_head_signal_regressor(humanoid, tmp_path / "one")
    features = torch.randn(1, 20, 13, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(
            again.from_features(features)["humanoid_state"], model.from_features(features)["humanoid_state"]
        )
    with pytest.raises(InputError, match="is not there"):
        load_head_signal_regressor(humanoid, tmp_path / "none")
