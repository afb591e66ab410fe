"""Forecasts beside a live stream: the offline ones, never queued, skipped by the rule, told in every form."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.live_stand_in import untrained, write_walk
from helpers.video_run import run  # noqa: F401  # a fixture
from helpers.waiting import PATIENCE, wait_until

from egopose.benchmarks import stream as bench
from egopose.benchmarks.stream import untrained_forecaster
from egopose.checkpoint.checkpoint import ComponentState, RunCheckpoint, metadata_of
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.context_states import context_states
from egopose.inference.forecaster import forecast
from egopose.inference.stream import messages
from egopose.inference.stream.build import (
    Forecaster,
    Trained,
    build_loop,
    load_forecaster,
    load_trained,
    source_settings,
    still_frames,
    stream,
)
from egopose.inference.stream.forecast_recording import ForecastRecording
from egopose.inference.stream.forecasting import ForecastThread
from egopose.inference.stream.latency import LatencyTable
from egopose.inference.stream.live_forecasts import ForecastSettings, LiveForecast, LiveFutures, Moment
from egopose.inference.stream.outputs import open_outputs
from egopose.models.recurrent import PastContext
from egopose.motion.io.native import skeleton_from_json
from egopose.pipeline.forecaster import still_forecasts
from egopose.pipeline.run import build_run
from egopose.training.continued_forecast import blank_continued_forecaster
from egopose.training.forecaster_settings import ForecasterSettings
from egopose.training.kernel_forecast import blank_kernel_forecaster
from egopose.training.motion_forecast import build_forecaster

CONTEXT = 30
LATENCY = ("forecast_encoder", "forecast_rollout", "forecast_output")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    with torch_threads(1):
        yield


@pytest.fixture(scope="module")
def trained() -> Trained:
    return untrained()


def values_of(*changed: str) -> dict[str, Any]:
    words = ["source=none", "checkpoint=none", "server.port=null", "planner=none"]
    return compose_config("stream", [*words, *changed])


def forecaster_of(trained: Trained, *changed: str) -> Forecaster:
    torch.manual_seed(3)
    made = untrained_forecaster(values_of(*changed), trained)
    for parameter in made.actor.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    return made


def moment_of(trained: Trained, frame: int = 29) -> Moment:
    draw = np.random.default_rng(frame)
    qpos = trained.humanoid.skeleton.rest_qpos()
    qpos[2] = 1.0
    qpos[7:] += 0.05 * draw.normal(size=len(qpos) - 7)
    flow = 0.01 * draw.normal(size=(CONTEXT, 2, 64, 64)).astype(np.float32)
    return Moment(frame, qpos, 0.1 * draw.normal(size=len(qpos) - 1), flow, 0.0)


@pytest.mark.parametrize("samples", [1, 3])
def test_futures_are_the_offline_forecasts(trained: Trained, samples: int) -> None:
    made = forecaster_of(trained, f"forecast.samples={samples}", "forecast.horizon=40", "forecast.seed=5")
    futures = LiveFutures(made.env, made.actor, made.regressor, made.settings, 0.3)
    moment = moment_of(trained)
    live = futures.roll(moment)
    again = futures.roll(moment)
    np.testing.assert_array_equal(live.qpos, again.qpos)
    assert live.qpos.shape == (40, trained.humanoid.mj_model.nq)

    # The environment's own way, its tables holding the same past.
    other = forecaster_of(trained, f"forecast.samples={max(samples - 1, 1)}")  # as many worlds as futures
    (past,) = (module for module in other.actor.modules() if isinstance(module, PastContext))
    with torch.no_grad():
        past.features_table = torch.zeros(CONTEXT + 1, past.features_table.shape[1])
        past.features_table[:CONTEXT] = trained.regressor.encode(torch.from_numpy(moment.flow))
    state = [torch.from_numpy(part)[None] for part in (moment.qpos, moment.qvel)]
    offline = forecast(other.env, other.actor, *state, samples, 40, seed=5 + moment.frame, noise_time=0.3)
    found = live.qpos[None] if samples == 1 else live.drawn
    # Single products and batches of them: rounding, which contacts amplify.
    np.testing.assert_allclose(found[:, :12], offline.qpos[0, :, :12], atol=1e-4)
    if samples == 1:
        assert not len(live.low)
        assert live.drawn.shape == (0, *live.qpos.shape)
    else:
        assert live.low.shape == live.high.shape == (40, trained.humanoid.mj_model.nu)
        inside = (live.low <= live.drawn[..., 7:]) & (live.drawn[..., 7:] <= live.high)
        assert 0.3 < inside.mean() < 1
        assert np.abs(live.drawn[:, -1] - live.qpos[-1]).max() > 1e-2


def test_a_fall_and_broken_physics_are_told(trained: Trained) -> None:
    made = forecaster_of(trained, "forecast.horizon=90")
    futures = LiveFutures(made.env, made.actor, made.regressor, made.settings, 0.3)
    moment = moment_of(trained)
    moment.qvel[4] = 3.0  # rad/s forward: nothing holds it
    fell = futures.roll(moment)
    assert fell.fallen is not None
    assert fell.fallen > 5
    assert not fell.diverged
    moment.qvel[8] = 990.0
    broken = futures.roll(moment)
    assert broken.diverged
    assert np.isfinite(broken.qpos).all()


class Slow:
    """ReferenceForecasts that take as long as they are told to."""

    context = 3

    def __init__(self) -> None:
        self.go, self.begun, self.moments = threading.Event(), threading.Event(), list[Moment]()

    def roll(self, moment: Moment, lap: Any) -> LiveForecast:
        self.moments.append(moment)
        self.begun.set()
        self.go.wait(5)
        lap("forecast_rollout")
        empty = np.empty((0, 1))
        return LiveForecast(moment.frame, np.zeros((1, 8)), np.empty((0, 1, 8)), empty, empty, None, False)


def thread_of(slow: Any, patient: bool = False) -> ForecastThread:
    latency = LatencyTable(LATENCY, 8, ("forecast", "forecast_delay"))
    return ForecastThread(slow, 4, 2, latency, patient)


def test_what_is_due_while_another_is_made_is_skipped_and_counted() -> None:
    slow, told = Slow(), list[int]()
    beside = thread_of(slow)
    beside.start(lambda forecast, delay_ms: told.append(forecast.frame))
    flow, qpos, qvel = np.ones((2, 4, 4), np.float32), np.zeros(8), np.zeros(7)
    for frame in range(20):
        beside.see(frame, flow * frame)
        if frame >= 2:
            beside.offer(frame - 2, qpos, qvel)
        if frame == 4:
            assert slow.begun.wait(5)
            qpos[0] = 7.0  # a copy was taken
    # Due at 2 (the first with 3 frames behind it), 6, 10, 14; the first is not done.
    assert beside.skipped == 3
    assert len(slow.moments) == 1
    assert slow.moments[0].frame == 2
    assert slow.moments[0].qpos[0] == 0.0
    np.testing.assert_array_equal(slow.moments[0].flow[:, 0, 0, 0], [0, 1, 2])
    assert len(beside._flow) <= slow.context + 2
    slow.go.set()
    wait_until(lambda: beside.made >= 1, "the first forecast")
    # Where frames are missing there is no past to forecast from until there is one again.
    for frame in range(30, 36):
        beside.see(frame, flow)
        beside.offer(frame - 2, qpos, qvel)
    beside.close()
    assert told == [2, 32]
    assert set(beside.latency.percentiles_ms()) == {*LATENCY, "forecast", "forecast_delay"}


def test_where_nothing_is_skipped_the_stream_waits() -> None:
    slow, told = Slow(), list[int]()
    slow.go.set()
    beside = thread_of(slow, patient=True)
    beside.start(lambda forecast, delay_ms: (time.sleep(0.01), told.append(forecast.frame)))
    for frame in range(20):
        beside.see(frame, np.zeros((2, 4, 4), np.float32))
        beside.offer(frame, np.zeros(8), np.zeros(7))
    beside.close()
    assert told == [2, 6, 10, 14, 18]
    assert not beside.skipped


def test_an_error_on_the_thread_ends_the_stream() -> None:
    slow = Slow()
    slow.go.set()
    beside = thread_of(slow, patient=True)

    def full(forecast: LiveForecast, delay_ms: float) -> None:
        raise InputError("x.npz", "forecast.out", "no space left")

    beside.start(full)
    for frame in range(3):
        beside.see(frame, np.zeros((2, 4, 4), np.float32))
        beside.offer(frame, np.zeros(8), np.zeros(7))
    beside._thread.join(5)
    with pytest.raises(InputError, match="no space left"):
        beside.offer(3, np.zeros(8), np.zeros(7))
    with pytest.raises(InputError, match="no space left"):
        beside.close()


def test_a_stream_forecasts_beside_its_estimate(trained: Trained, tmp_path: Path) -> None:
    pytest.importorskip("websockets")
    from websockets.sync.client import connect

    video = write_walk(tmp_path / "walk.mp4", 62)
    out = tmp_path / "futures.npz"
    chosen = ["forecast.samples=2", "forecast.horizon=15", f"forecast.out={out}", "failsafe.mode=value"]
    values = {**values_of(*chosen), "source": str(video), "pace": "every"}
    values["server"] = {**values["server"], "port": 0}
    made = forecaster_of(trained, *chosen)
    loop = build_loop(values, trained, source_settings(values), made)

    received: dict[str, list[Any]] = {"json": [], "binary": []}
    with contextlib.ExitStack() as stack:
        sinks = open_outputs(values, trained.humanoid, source_settings(values), made.settings, stack)

        def read(kind: str) -> None:
            with connect(f"ws://127.0.0.1:{sinks.port}/{kind}") as client:
                received[kind].extend(client)

        readers = [threading.Thread(target=read, args=(kind,), daemon=True) for kind in received]
        for reader in readers:
            reader.start()
        wait_until(lambda: all(received.values()), "each client's first message")
        last = loop.run(sinks.on_pose, sinks.on_status, None, sinks.on_forecast)
    for reader in readers:
        reader.join(PATIENCE)
    assert last["poses"] == 62
    # From the thirtieth frame on, every ninth.
    assert last["forecasts"] == 4
    assert last["forecasts_skipped"] == 0
    assert {"forecast", "forecast_delay", *LATENCY} < set(last["stages"])
    with np.load(out, allow_pickle=False) as written:
        header = json.loads(bytes(written["header"]))
        stored = {name: written[name] for name in written.files}
    assert skeleton_from_json(header["skeleton"]) == trained.humanoid.skeleton
    assert stored["frame"].tolist() == [29, 38, 47, 56]
    assert stored["drawn"].shape == (4, 2, 15, 59)
    assert (stored["low"] <= stored["high"]).all()
    greeting = json.loads(received["json"][0])
    assert greeting["forecast"] == {"every": 0.3, "horizon": 15, "samples": 2, "level": 0.8}
    in_text = [m for m in map(json.loads, received["json"]) if m["type"] == "forecast"]
    in_bytes = [m for m in received["binary"] if isinstance(m, bytes) and m[:4] == messages.MAGIC_FORECAST]
    assert in_text
    assert in_bytes
    for text in in_text:
        row = stored["frame"].tolist().index(text["frame"])
        np.testing.assert_allclose(text["qpos"], stored["qpos"][row], atol=1e-4)
        np.testing.assert_allclose(text["high"], stored["high"][row], atol=1e-4)
    back = messages.read_forecast_binary(in_bytes[-1])
    row = stored["frame"].tolist().index(back["frame"])
    np.testing.assert_array_equal(back["qpos"], stored["qpos"][row])
    np.testing.assert_array_equal(back["low"], stored["low"][row])
    for broken in (b"", b"EGOF", in_bytes[0][:-1]):
        with pytest.raises(InputError):
            messages.read_forecast_binary(broken)


@pytest.fixture(scope="module")
def forecasting_run(trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory of an untrained forecasting policy."""
    folder = tmp_path_factory.mktemp("forecasting")
    small = ["collector.num_envs=2", "algo.steps_per_iteration=16", "algo.minibatch_size=16", "logger=csv"]
    config = compose_config("train", ["experiment=forecasting", *small])
    size = StateLayout(trained.humanoid.mj_model.nu).size
    weights = {"regressor": trained.regressor, "config": {"state_size": size, **config}}
    RunCheckpoint(weights).save(folder / "regressor", metadata=metadata_of("regressor", size, 1, 0, 0.0))
    dataset = still_frames(trained.humanoid, trained.regressor, trained.source_config, 70)
    made = build_run(config, folder, dataset)
    made.save()
    made.collector.shutdown()
    return folder


@pytest.fixture(scope="module", params=["forecasting_follow", "tracked_forecasting"])
def following_run(request: Any, trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory of an untrained policy that follows kinematic forecasts, whose networks are untrained too."""
    folder = tmp_path_factory.mktemp("following")
    small = ["collector.num_envs=2", "algo.steps_per_iteration=16", "algo.minibatch_size=16", "logger=csv"]
    config = compose_config("train", [f"experiment={request.param}", "regressor=fast", *small])
    size = StateLayout(trained.humanoid.mj_model.nu).size
    weights = {"regressor": trained.regressor, "config": {"state_size": size, **config}}
    RunCheckpoint(weights).save(folder / "regressor", metadata=metadata_of("regressor", size, 1, 0, 0.0))
    values = {key: value for key, value in config["forecaster"].items() if key != "optimiser"}
    settings, pose = ForecasterSettings.from_config(values), StateLayout(trained.humanoid.mj_model.nu).pose_size
    parts = [build_forecaster(settings, torch.zeros(pose), torch.ones(pose), 30.0, k) for k in range(settings.members)]
    blank = blank_kernel_forecaster(settings, torch.zeros(pose), torch.ones(pose), 30.0, 4)
    blank.kept.fill_(0.4)
    sizes = {"centres": torch.tensor(4)}
    kept: dict[str, Any] = {"members": torch.nn.ModuleList(parts), "kernel": blank}
    kept["sizes"] = ComponentState(lambda: sizes, lambda _: None)
    kept["continued"] = blank_continued_forecaster(settings, torch.zeros(pose), torch.ones(pose), 30.0)
    RunCheckpoint(kept).save(folder / "forecaster", metadata=metadata_of("motion forecaster", pose, 0, 0, 0.0))
    dataset = still_forecasts(config, still_frames(trained.humanoid, trained.regressor, trained.source_config, 70))
    made = build_run(config, folder, dataset)
    made.save()
    made.collector.shutdown()
    return folder


@pytest.mark.parametrize("samples", [1, 3])
def test_a_run_that_follows_forecasts_live_what_it_does_offline(
    trained: Trained, following_run: Path, samples: int
) -> None:
    told = [f"forecast.checkpoint={following_run}", "forecast.which=latest", "forecast.horizon=20", "forecast.seed=5"]
    made = load_forecaster(values_of(*told, f"forecast.samples={samples}"), trained)
    assert made is not None
    futures = LiveFutures(made.env, made.actor, made.regressor, made.settings, 0.3, made.curves)
    moment = moment_of(trained)
    moment.qpos[:2] = 2.0, 3.0
    live = futures.roll(moment)
    other = load_forecaster(values_of(*told, f"forecast.samples={max(samples - 1, 1)}"), trained)
    assert other is not None
    assert other.curves is not None
    now, problem = torch.tensor([CONTEXT - 1]), other.env.base_env.problem
    forecasts = problem.forecasts
    seen = context_states(other.regressor, torch.from_numpy(moment.flow), [0], CONTEXT).double()
    forecasts.put(other.curves(seen), now)
    first = forecasts.first_state(now, torch.from_numpy(moment.qpos)[None], problem.humanoid.joint_range)
    offline = forecast(other.env, other.actor, *first, samples, 20, seed=5 + moment.frame, noise_time=0.3)
    found = live.qpos[None] if samples == 1 else live.drawn
    np.testing.assert_allclose(found[:, :12], offline.qpos[0, :, :12], atol=1e-4)
    np.testing.assert_allclose(live.qpos[0, :2], [2.0, 3.0], atol=0.1)
    # Another past, another curve.
    again = futures.roll(replace(moment, frame=400, flow=-50 * moment.flow))
    assert np.abs(again.qpos - live.qpos).max() > 1e-4


def test_a_forecasting_run_is_used_by_its_path(run: Path, forecasting_run: Path, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "futures.npz"
    told = [f"forecast.checkpoint={forecasting_run}", "forecast.which=latest", "forecast.horizon=5", "which=latest"]
    video = write_walk(tmp_path / "walk.mp4", 45)
    chosen = {**values_of(*told, f"forecast.out={out}"), "source": str(video), "checkpoint": str(run), "pace": "every"}
    last = stream(chosen)
    assert (last["poses"], last["forecasts"]) == (45, 2)
    with np.load(out, allow_pickle=False) as written:
        assert written["frame"].tolist() == [29, 38]
    with pytest.raises(InputError, match="this run's is estimation: a live forecast is one of"):
        stream({**chosen, "forecast": {**chosen["forecast"], "checkpoint": str(run)}})
    other = {**load_trained(str(run), "latest").source_config}
    other["vision"] = {**other["vision"], "flow": {**other["vision"]["flow"], "working_size": 64}}
    with pytest.raises(InputError, match="another flow"):
        load_forecaster(chosen, replace(untrained(), source_config=other))


def test_a_soak_reports_what_is_promised(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "untrained", lambda config: trained)
    monkeypatch.setattr(bench, "_TELL_EVERY", 1.0)
    words = ["pace=real_time", "seconds=3.5", "forecast.checkpoint=untrained", "forecast.horizon=5", "server.port=0"]
    video = write_walk(tmp_path / "walk.mp4", 40)
    found = bench.run([f"stream.source={video}", *(f"stream.{word}" for word in words)], 1)
    assert {"fps", "p50_ms", "p95_ms", "p99_ms", "dropped", "stages"} < set(found)
    assert {"rss_start_mb", "rss_mb", "rss_growth_mb", "rss_slope_mb_per_hour"} < set(found)
    assert found["fps"] == found["paced_fps"] <= 31
    assert {"forecasts", "forecasts_skipped", "reconnects"} < set(found)
    assert " MB" in capsys.readouterr().err


def test_forecasts_do_not_hold_the_live_stream_up(trained: Trained, tmp_path: Path) -> None:
    """A forecast that is not finished before twenty more frames are: were it waited for, neither would come."""
    chosen = values_of("forecast.horizon=3", "seconds=30")
    values = {**chosen, "source": str(write_walk(tmp_path / "walk.mp4", 60)), "repeat": True}
    loop = build_loop(values, trained, source_settings(values), forecaster_of(trained, "forecast.horizon=3"))
    begun, enough, stop = threading.Event(), threading.Event(), threading.Event()
    since = 0

    def on_pose(pose: Any, delay_ms: float) -> None:
        nonlocal since
        since += begun.is_set()
        if since == 20:
            enough.set()
            stop.set()

    def on_forecast(coming: LiveForecast, delay_ms: float) -> None:
        begun.set()
        enough.wait(20)

    last = loop.run(on_pose, lambda s: None, stop, on_forecast)
    assert enough.is_set()
    assert last["forecasts"] == 1
    assert last["forecasts_skipped"] >= 1
    assert last["seconds"] < 25


def test_one_row_is_a_mean_future_without_bands(trained: Trained) -> None:
    empty = np.empty((0, 52))
    sent = LiveForecast(12, np.ones((3, 59)), np.empty((0, 3, 59)), empty, empty, 2, True)
    text = json.loads(messages.forecast_json(sent, 30.0, 80.0))
    assert (text["low"], text["high"], text["fallen"], text["diverged"]) == (None, None, 2, True)
    back = messages.read_forecast_binary(messages.forecast_binary(sent, 30.0, 80.0))
    assert (back["low"], back["fallen"], back["diverged"], back["delay_ms"]) == (None, 2, True, 80.0)
    assert back["qpos"].shape == (3, 59)


def test_no_forecast_leaves_no_file(tmp_path: Path, trained: Trained) -> None:
    settings = ForecastSettings(0.3, 5, 1, 0.8, 0.0, 0)
    empty = ForecastRecording(tmp_path / "none.npz", trained.humanoid.skeleton, 30.0, settings)
    empty.close()
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"\.npz"):
        ForecastRecording(tmp_path / "x.json", trained.humanoid.skeleton, 30.0, settings)


@pytest.mark.parametrize(
    ("changed", "field"),
    [({"every": 0.0}, "every"), ({"horizon": 0}, "horizon"), ({"samples": 0}, "samples"), ({"level": 1.0}, "level")],
)
def test_settings_that_cannot_be_are_named(changed: dict[str, float], field: str) -> None:
    good = {"every": 0.3, "horizon": 90, "samples": 1, "level": 0.8, "noise_time": 0.3, "seed": 0}
    with pytest.raises(InputError, match=f"forecast.{field}"):
        ForecastSettings(**{**good, **changed})
