"""An evaluation of forecasts, from agents to files, on the real humanoid with made-up motion and untrained networks."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.env_stand_in import Piece, group
from markupsafe import escape

from egopose.core.errors import InputError
from egopose.data.reference import reference_states
from egopose.data.spans import Span
from egopose.data.windows import ForecastWindow
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.problem import TakeTable
from egopose.evaluation.forecast_run import run_forecast_evaluation
from egopose.evaluation.reports import evaluation_report
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.model import build_humanoid
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.context_states import context_states
from egopose.inference.forecast_contexts import _states, context_dataset, past_states
from egopose.inference.outputs import TakeVideo
from egopose.inference.video_regression import require_estimation
from egopose.models.predictions import predict_span
from egopose.models.regressor import StateRegressor
from egopose.motion.io import read_motion
from egopose.motion.motion import Motion
from egopose.pipeline.agent import Agent
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.tasks.dataset import Dataset
from egopose.vision.video import probe_video, write_video

FRAMES, CONTEXT = 40, 5
EVALUATE: dict[str, Any] = {
    "split": "test",
    "forecast": {
        "horizon": None,
        "every": 8,
        "samples": 4,
        "level": 0.8,
        "noise_time": 0.3,
        "start": "reference",
        "estimator": None,
        "num_envs": 10,
        "seed": 0,
    },
    "failsafe": {"mode": "value", "reset_threshold": 0.6, "fallen_height": 0.3},
    "interval": {"level": 0.95, "draws": 50, "seed": 0},
    "video": {"takes": 1, "size": 64},
    "threads": 1,
}


@pytest.fixture(scope="module")
def agent() -> Agent:
    humanoid = build_humanoid(HumanoidConfig.from_mapping(group("humanoid", "default")), SimConfig(substeps=3))
    qpos = np.tile(humanoid.skeleton.rest_qpos(), (FRAMES, 1))
    qpos[:, 2] = 0.95
    qpos[:, 7:] = humanoid.rest_action + 0.05 * np.sin(np.linspace(0, 6, FRAMES))[:, None]
    states = reference_states(humanoid, Motion(humanoid.skeleton, qpos, 30.0))
    heads = states["xpos"][:, humanoid.head, 2].min().expand(2).clone()
    dataset = Dataset(
        humanoid,
        torch.cat([states, states]),
        TakeTable(torch.tensor([0, FRAMES]), torch.tensor([FRAMES, FRAMES]), heads),
        train=[Piece(0, 0, FRAMES)],
        test=[Piece(0, 4, FRAMES), Piece(1, 0, 20)],
        visual_features=torch.randn(2 * FRAMES, 6, generator=torch.Generator().manual_seed(0)),
    )
    model = group("model", "forecasting")
    config = {
        "seed": 5,
        "task": {**group("task", "forecasting"), "context": CONTEXT, "horizon": 13, "minimum": 6},
        "reward": group("reward", "forecasting"),
        "algo": {},
        "model": {
            **model,
            "hidden": [8],
            "context": {**model["context"], "hidden_size": 4, "horizon": CONTEXT},
            "memory": {"hidden_size": 7},
        },
    }
    actor, critic = build_networks(config, dataset, build_env(config, dataset, num_envs=1))
    return Agent(actor, critic, config, dataset, partial(build_env, config, dataset), Path("run/checkpoints/1"))


def test_everything_is_written_and_agrees(agent: Agent, tmp_path: Path) -> None:
    write_video(tmp_path / "wearer.mp4", [np.full((48, 64, 3), 90, np.uint8)] * FRAMES, 30.0)
    video = TakeVideo(tmp_path / "wearer.mp4", 0.0, rendered=True)
    out = tmp_path / "out"
    try:
        text = run_forecast_evaluation(EVALUATE, [agent, agent], ["walk/1", "bow"], [video, None], out)
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    saved = json.loads((out / "results.json").read_text())
    assert saved["windows"] == ["walk/1_4", "walk/1_12", "walk/1_20", "bow_0"]
    assert saved["rendered_video"]
    assert set(saved["figures"]) == {"ours", "ours, drawn", "ours, drawn, best of 4", "standing still"}
    shortest, *longer = saved["figures"]["ours"]["E_pose"]  # 12 frames: 1/3 s alone
    assert (shortest["runs"], shortest["takes"]) == (2, 2)
    assert longer == [None] * 4
    still = saved["figures"]["standing still"]
    assert still["A_accl"][0]["value"] == 0
    assert set(saved["ratios"]) == {"standing still"}
    assert saved["ratios"]["standing still"]["A_accl"] == [None] * 5
    ratio = saved["ratios"]["standing still"]["E_pose"][0]["value"]
    assert ratio == pytest.approx(shortest["value"] / still["E_pose"][0]["value"])
    coverage = saved["coverage"][0]
    assert coverage["calibration"] == pytest.approx(0.8, abs=0.02)
    assert coverage["calibration_windows"] == 3
    assert len(coverage["held_out_per_frame"]) == 12

    with (out / "windows.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if (row["method"], row["run"]) == ("ours", "0")]
    per_window = {row["window"]: float(row["E_pose"]) for row in rows}
    walk = np.mean([per_window[f"walk/1_{start}"] for start in (4, 12, 20)])
    assert shortest["value"] == pytest.approx((walk + per_window["bow_0"]) / 2, rel=1e-6)

    folder = out / "windows/walk_1_4"
    forecast, future = (read_motion(folder / f"{name}.npz") for name in ("forecast", "future_0"))
    assert len(forecast) == len(future) == 12
    assert not np.array_equal(forecast.qpos, future.qpos)
    np.testing.assert_allclose(
        read_motion(folder / "reference.npz").qpos, agent.dataset.reference["qpos"][9:21].numpy(), atol=1e-6
    )
    with (folder / "bands.csv").open() as stream:
        bands = list(csv.DictReader(stream))
    assert len(bands) == 12
    assert float(bands[3]["Spine_0_low"]) < float(bands[3]["Spine_0_median"]) < float(bands[3]["Spine_0_high"])
    assert (probe_video(folder / "futures.mp4").width, probe_video(folder / "futures.mp4").frames) == (128, 12)
    assert not (out / "windows/walk_1_12/futures.mp4").exists()
    for word in ("E_pose", "nominal 80%", str(out)):
        assert word in text
    still_pose = read_motion(folder / "other_standing_still.npz").qpos
    assert np.ptp(still_pose, axis=0).max() == 0
    seen = json.loads((folder / "wearer.json").read_text())
    assert (Path(seen["video"]), seen["rendered"]) == (video.path.resolve(), True)
    assert seen["start"] == pytest.approx(9 / 30)  # the first frame that was not seen
    assert not (out / "windows/bow_0/wearer.json").exists()
    _check_page(evaluation_report(out, agent.dataset.humanoid, ["evaluation.size=64"]), saved)
    (folder / "forecast.npz").unlink()
    with pytest.raises(InputError, match="evaluate anew"):
        evaluation_report(out, None)
    (out / "results.json").write_text(json.dumps({**saved, "figures": {"ours": {}}}))
    with pytest.raises(InputError, match=r"damaged|evaluate anew"):
        evaluation_report(out, None)


def _check_page(path: Path, saved: dict[str, Any]) -> None:
    """It holds all it shows: figures in full, a line a method, strips of worst and best windows, the command."""
    text = path.read_text()
    assert "http:" not in text
    assert "https:" not in text
    held = re.search(r'<script type="application/json" id="data">(.*?)</script>', text)
    assert held is not None
    assert json.loads(held[1]) == saved
    for method in ("ours", "standing still"):
        assert f'data-value="{saved["figures"][method]["E_pose"][0]["value"]!r}"' in text
    assert text.count('class="band"') >= 3 * 4 + 1  # three metrics of four methods, and the spread over windows
    assert text.count("<img ") == 4  # two of the four windows are the worst, two the best
    assert str(escape(saved["command"])) in text  # as the templates do it
    assert "rendered from real motion capture" in text


def test_bad_settings_are_named(agent: Agent, tmp_path: Path) -> None:
    def fails(match: str, **forecast: Any) -> None:
        settings = {**EVALUATE, "forecast": {**EVALUATE["forecast"], **forecast}}
        with pytest.raises(InputError, match=match):
            run_forecast_evaluation(settings, [agent], ["a", "b"], [None, None], tmp_path)

    fails("at most 31", horizon=60)
    fails("one of regressor", start="somewhere")
    fails("none", start="regressor")
    fails("estimation policy", start="estimator")
    fails("at least 1", samples=0)
    with pytest.raises(InputError, match="split"):
        run_forecast_evaluation({**EVALUATE, "split": "all"}, [agent], ["a", "b"], [None, None], tmp_path)


def test_contexts_become_takes_by_themselves(agent: Agent) -> None:
    whole = agent.dataset
    frames = torch.cat([torch.arange(4, 9), torch.arange(40, 45)])
    names = ("visual_features", "visual_context", "joint_targets", "humanoid_state")
    seen = {name: torch.arange(10.0)[:, None].repeat(1, 3) for name in names}
    dataset = context_dataset(whole, [4, 40], CONTEXT, seen)
    assert dataset.takes.offsets.tolist() == [0, 5]
    assert dataset.takes.lengths.tolist() == [5, 5]
    assert torch.equal(dataset.reference["qpos"], whole.reference["qpos"][frames])
    lowest = [float(whole.reference["xpos"][rows, whole.humanoid.head, 2].min()) for rows in frames.split(5)]
    assert dataset.takes.lowest_head_height.tolist() == pytest.approx(lowest)
    assert [(f.take, f.start, f.stop) for f in dataset.test] == [(0, 0, 5), (1, 0, 5)]
    assert dataset.states is seen["humanoid_state"]


def test_true_contexts_are_the_references_states(agent: Agent) -> None:
    windows = [ForecastWindow(0, 4, CONTEXT, 12), ForecastWindow(1, 0, CONTEXT, 12)]
    states = past_states(agent, windows, "reference")
    every = humanoid_state(agent.dataset.reference)
    assert torch.equal(states, torch.stack([every[4:9], every[40:45]]))


def test_where_the_fail_safe_moved_the_body_its_velocity_is_the_regressors(agent: Agent) -> None:
    qpos = agent.dataset.reference["qpos"][:6].numpy()
    layout = StateLayout(qpos.shape[1] - 7)
    regressed = torch.full((6, layout.size), 7.0, dtype=torch.float64)
    plain = _states(qpos, np.zeros(6, dtype=bool), regressed, 30.0)
    states = _states(qpos, np.array([0, 0, 1, 0, 0, 1], dtype=bool), regressed, 30.0)
    assert (states[[1, 4, 5], layout.velocities] == 7.0).all()
    assert torch.equal(*(each[:, : layout.joint_angles.stop] for each in (states, plain)))
    assert torch.equal(states[[0, 2, 3]], plain[[0, 2, 3]])


def test_a_run_that_forecasts_does_not_estimate(agent: Agent, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="this run forecasts"):
        require_estimation(agent.config, "run")
    other = replace(agent, config={**agent.config, "task": group("task", "estimation")})
    require_estimation(other.config, "run")
    with pytest.raises(InputError, match="does not forecast"):
        run_forecast_evaluation(EVALUATE, [agent, other], ["a", "b"], [None, None], tmp_path)


def test_states_of_a_context_know_nothing_of_what_follows() -> None:
    torch.manual_seed(0)
    model = StateRegressor(None, torch.zeros(5), torch.ones(5), feature_size=6, context_size=4, hidden=[8]).eval()
    features = torch.randn(40, 6)
    states = context_states(model, features, [3, 20], 7)
    assert states.shape == (2, 7, 5)
    torch.testing.assert_close(states[1], predict_span(model, features[20:27], Span(0, 7), 4)["humanoid_state"])
    later = features.clone()
    later[27:] += 1.0
    torch.testing.assert_close(context_states(model, later, [3, 20], 7), states)
    whole = predict_span(model, features, Span(0, 40), 64)["humanoid_state"]
    assert not torch.allclose(whole[20:27], states[1], atol=1e-4)
