"""A forecasting policy on windows of held-out takes: its mean future, drawn futures with bands, and the figures."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.result_files import write_columns_csv
from egopose.core.torch_settings import torch_threads
from egopose.data.fragments import FragmentLike
from egopose.data.windows import ForecastWindow, forecast_windows
from egopose.evaluation import forecast_report as report
from egopose.evaluation.forecast_metrics import score_forecasts, true_futures
from egopose.evaluation.forecast_report import other_file
from egopose.inference.bands import Bands, fit_scale, quantile_bands
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.forecast_contexts import SOURCES, past_states
from egopose.inference.forecast_start import begin_forecasts
from egopose.inference.forecaster import Forecasts, forecast
from egopose.inference.outputs import RENDERED_NOTE, TakeVideo, file_name, write_footage, write_motion_files
from egopose.inference.planners import AnyPlannerSettings, build_planner, read_planner
from egopose.models.baselines.recurrent import RecurrentForecaster
from egopose.motion.io import write_motion
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.agent import Agent
from egopose.pipeline.baselines import forecast_qpos, load_baseline
from egopose.tasks.dataset import Dataset
from egopose.tasks.task import task_of

OURS, DRAWN, STILL = "ours", "ours, drawn", "standing still"

_PLANNED_TOGETHER = 4096  # copies of bodies: what they do takes 30 kB each


@dataclass(frozen=True)
class ForecastSettings:
    """The group ``forecast`` of ``conf/evaluate.yaml``.

    Args:
        horizon: frames of the future, None for as many as the policy was trained to forecast.
        every: frames between windows.
        samples: drawn futures a window; 1 for none.
        level: of the error bands.
        noise_time: s, see :func:`egopose.inference.forecaster.forecast`.
        start: where forecasts begin, one of :data:`egopose.inference.forecast_contexts.SOURCES`.
        estimator: run directory of an estimation policy, read by ``start`` ``estimator``.
        num_envs: simulated side by side.
        seed: of the drawn futures.
    """

    horizon: int | None
    every: int
    samples: int
    level: float
    noise_time: float
    start: str
    estimator: str | None
    num_envs: int
    seed: int

    def __post_init__(self) -> None:
        if self.start not in SOURCES:
            cause = f"must be one of {', '.join(SOURCES)}, not {self.start!r}"
            raise InputError("conf/evaluate.yaml", "forecast.start", cause)
        for name in ("every", "samples", "num_envs"):
            if getattr(self, name) < 1:
                raise InputError("conf/evaluate.yaml", f"forecast.{name}", "must be at least 1")
        if self.horizon is not None and self.horizon < 10:
            raise InputError("conf/evaluate.yaml", "forecast.horizon", "must be at least 10 frames")


def run_forecast_evaluation(
    config: Mapping[str, Any],
    agents: Sequence[Agent],
    names: Sequence[str],
    videos: Sequence[TakeVideo | None],
    out: Path,
) -> str:
    """Score forecasting agents (runs with different seeds), write everything, and return what the terminal shows.

    Args:
        config: resolved ``conf/evaluate.yaml``.
        agents: see :func:`egopose.pipeline.agent.load_agent`; all on the same takes.
        names: of all takes of the dataset.
        videos: of all takes; None where there is none to show.
        out: folder of the results.

    Raises:
        InputError: a setting is wrong, or no fragment of the split is long enough for a window.
    """
    values = dict(config["forecast"])
    compared = dict(values.pop("baselines", None) or {})
    settings = from_mapping(ForecastSettings, values, "conf/evaluate.yaml: forecast")
    for agent in agents:
        if task_of(agent.config).protocol != "forecasts":
            raise InputError(agent.path, "task", "this run does not forecast, others of these do")
    dataset, split = agents[0].dataset, str(config["split"])
    humanoid, fps = dataset.humanoid, 1.0 / dataset.humanoid.control_dt
    windows = windows_of(agents[0], split, settings)
    labels = [f"{names[w.take]}_{w.start}" for w in windows]
    truth = _truth(dataset, windows)
    hands = [int(d) for d in humanoid.hand_dofs]

    planner = read_planner(config.get("planner"))
    methods: dict[str, list[Any]] = {OURS: [], DRAWN: [], STILL: []}
    coverage, futures = [], []
    others: dict[str, Array] = {}  # of the first run: [W, H, nq] of whatever it is compared with
    for number, agent in enumerate(agents):
        pasts = _pasts(config, agent, windows, settings)
        for name, run in compared.items() if number == 0 else ():
            reported = _baseline_futures(agent, windows, pasts, str(run))
            methods[name] = [score_forecasts(truth, windows, reported, hands, fps)]
            others[name] = reported[:, 0]
        states = begin_forecasts(agent, windows, pasts)
        mean = forecast_windows_of(agent, windows, states, 1, settings, int(config["threads"]), planner)
        methods[OURS].append(score_forecasts(truth, windows, mean.qpos, hands, fps))
        still = states[0].numpy()[:, None, None].repeat(windows[0].horizon, axis=2)
        methods[STILL].append(score_forecasts(truth, windows, still, hands, fps))
        others.setdefault(STILL, still[:, 0])
        drawn, bands = None, None
        if settings.samples > 1:
            drawn = forecast_windows_of(agent, windows, states, settings.samples, settings, int(config["threads"]))
            methods[DRAWN].append(score_forecasts(truth, windows, drawn.qpos, hands, fps))
            bands, result = _bands(config, agent, drawn.qpos, truth, settings, hands)
            coverage.append(result)
        futures.append((mean, drawn, bands))
    methods = {name: runs for name, runs in methods.items() if runs}

    interval = config["interval"]
    comparison = report.compare_forecasts(
        methods, OURS, float(interval["level"]), int(interval["draws"]), int(interval["seed"])
    )
    rendered = any(v is not None and v.rendered for v in videos)
    notes = [
        f"{len(agents)} run{'s' if len(agents) > 1 else ''}, {len(windows)} windows of "
        f"{len({w.take for w in windows})} takes, split {split}; {windows[0].context} frames seen, "
        f"{windows[0].horizon} forecast, begun from the {settings.start}'s state.",
        "A figure at a horizon is the mean up to it; the mean over windows in a take, then over takes.",
        *(_coverage_note(number, result, settings.level) for number, result in enumerate(coverage)),
        *([RENDERED_NOTE] if rendered else []),
    ]
    about = {
        "command": shlex.join(sys.orig_argv),
        "checkpoints": [str(agent.path) for agent in agents],
        "split": split,
        "rendered_video": rendered,
        "settings": {key: config[key] for key in ("forecast", "interval")},
        "fallen_share": [float(mean.fallen.mean()) for mean, _, _ in futures],
        "diverged": [int(mean.diverged.sum()) for mean, _, _ in futures],
        "coverage": coverage,
        "notes": notes,
    }
    report.write_forecast_results(out, comparison, methods, windows, labels, about, notes)
    written = _write_windows(out, config, dataset, windows, labels, truth, futures[0], others, videos)
    header, body = report.rows(comparison)
    widths = [max(len(line[i]) for line in [header, *body]) for i in range(len(header))]
    table = "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in [header, *body])
    return "\n".join([table, *notes, *(f"video: {path}" for path in written), f"all results: {out}"])


def windows_of(agent: Agent, split: str, settings: ForecastSettings) -> list[ForecastWindow]:
    """The windows of a split.

    Raises:
        InputError: there is none; names the longest horizon there is room for.
    """
    if split not in ("train", "test"):
        raise InputError("conf/evaluate.yaml", "split", f"must be train or test, not {split!r}")
    fragments: Sequence[FragmentLike] = agent.dataset.train if split == "train" else agent.dataset.test
    context = task_of(agent.config).context(agent.config)
    assert context is not None  # a forecasting run is asked
    horizon = settings.horizon or int(agent.config["task"]["horizon"]) - 1
    windows = forecast_windows(fragments, context, horizon, settings.every)
    if not windows:
        longest = max(f.stop - f.start for f in fragments) - context
        cause = f"no {split} fragment holds {context} + {horizon} frames; forecast.horizon may be at most {longest}"
        raise InputError("conf/evaluate.yaml", "forecast.horizon", cause)
    return windows


def _pasts(
    config: Mapping[str, Any], agent: Agent, windows: Sequence[ForecastWindow], settings: ForecastSettings
) -> Tensor:
    """:func:`~egopose.inference.forecast_contexts.past_states` as ``conf/evaluate.yaml`` says, in parts."""
    failsafe = from_mapping(FailSafeSettings, config["failsafe"], "conf/evaluate.yaml: failsafe")
    parts = [windows[at : at + settings.num_envs] for at in range(0, len(windows), settings.num_envs)]
    threads = int(config["threads"])
    return torch.cat([past_states(agent, p, settings.start, settings.estimator, failsafe, threads) for p in parts])


def _baseline_futures(agent: Agent, windows: Sequence[ForecastWindow], pasts: Tensor, run: str) -> Array:
    """``[W, 1, H, nq]`` of a trained recurrent baseline that has seen ``pasts [W, context, S]``.

    Raises:
        InputError: the run is not one of a recurrent baseline of the same humanoid.
    """
    model = load_baseline(run).model
    if not isinstance(model, RecurrentForecaster):
        raise InputError(run, "baseline", "forecasts nothing; name runs of baseline=erd or aclstm")
    return forecast_qpos(model, pasts, agent.dataset, windows)[:, None]


def forecast_windows_of(
    agent: Agent,
    windows: Sequence[ForecastWindow],
    states: tuple[Tensor, Tensor],
    samples: int,
    settings: ForecastSettings,
    threads: int,
    planner: AnyPlannerSettings | None = None,
) -> Forecasts:
    """:func:`egopose.inference.forecaster.forecast` of all windows, as many at a time as ``settings.worlds`` allow.

    A body that follows a kinematic forecast looks ahead where there is a planner; one that remembers does not, as a
    planner's ways begin without a memory.
    """
    parts, together = [], max(1, settings.num_envs // samples)
    if planner is not None:
        together = min(together, max(1, _PLANNED_TOGETHER // planner.samples))
    for at in range(0, len(windows), together):
        part = windows[at : at + together]
        options = {"threads": threads, "whole_fragments": True, "falls_end": False}
        drawn = [window for window in part for _ in range(samples)]
        env = agent.make_env(num_envs=len(drawn), fragments=drawn, **options)
        qpos, qvel = (state[at : at + together] for state in states)
        horizon, seed = part[0].horizon, settings.seed + at
        ahead, forecasts = None, agent.dataset.forecasts
        if planner is not None and forecasts is not None:
            now = torch.tensor([int(agent.dataset.takes.offsets[w.take]) + w.now for w in part])
            copies = agent.make_env(num_envs=len(part) * planner.samples, fragments=part, **options)
            followed = copies.base_env.problem.followed(now)
            ahead = build_planner(copies, agent.actor, agent.critic, planner, followed)
        with torch_threads(1):
            parts.append(forecast(env, agent.actor, qpos, qvel, samples, horizon, seed, settings.noise_time, ahead))
        env.close()
        if ahead is not None:
            ahead.close()
    return Forecasts(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("qpos", "fallen", "diverged")))


def _truth(dataset: Dataset, windows: Sequence[ForecastWindow]) -> Array:
    reference = torch.as_tensor(dataset.reference["qpos"]).double().numpy()
    return true_futures(reference, dataset.takes.offsets.tolist(), windows)


def _bands(
    config: Mapping[str, Any],
    agent: Agent,
    drawn: Array,
    truth: Array,
    settings: ForecastSettings,
    hands: list[int],
) -> tuple[Bands, dict[str, Any]]:
    """Bands of the joints, calibrated on windows of the training takes, and how often the truth is inside."""
    used = [7 + d for d in range(drawn.shape[-1] - 7) if d not in hands]
    bands = quantile_bands(drawn[..., used], settings.level)
    kept = windows_of(agent, "train", settings)
    states = begin_forecasts(agent, kept, _pasts(config, agent, kept, settings))
    futures = forecast_windows_of(agent, kept, states, settings.samples, settings, int(config["threads"]))
    known = quantile_bands(futures.qpos[..., used], settings.level)
    known_truth = _truth(agent.dataset, kept)[..., used]
    scale = fit_scale(known, known_truth, settings.level)
    calibrated, inside = bands.scaled(scale), bands.covers(truth[..., used])
    covered = calibrated.covers(truth[..., used])
    return calibrated, {
        "level": settings.level,
        "calibration_windows": len(kept),
        "windows": len(drawn),
        "calibration": float(known.scaled(scale).covers(known_truth).mean()),
        "held_out": float(covered.mean()),
        "held_out_uncalibrated": float(inside.mean()),
        "held_out_per_frame": covered.mean(axis=(0, 2)).tolist(),
        "scale_per_frame": scale.tolist(),
        "mean_width_rad": float((calibrated.high - calibrated.low).mean()),
    }


def _coverage_note(run: int, found: Mapping[str, Any], level: float) -> str:
    return (
        f"Run {run}: bands of nominal {level:.0%} hold {found['held_out']:.1%} of the joint angles on these windows "
        f"({found['held_out_uncalibrated']:.1%} before calibration on {found['calibration_windows']} training windows)."
    )


def _write_windows(
    out: Path,
    config: Mapping[str, Any],
    dataset: Dataset,
    windows: Sequence[ForecastWindow],
    labels: Sequence[str],
    truth: Array,
    futures: tuple[Forecasts, Forecasts | None, Bands | None],
    others: Mapping[str, Array],
    videos: Sequence[TakeVideo | None],
) -> list[Path]:
    """Motions and bands of each window, and videos of the first ones; returns the videos."""
    humanoid, fps = dataset.humanoid, 1.0 / dataset.humanoid.control_dt
    mean, drawn, bands = futures
    used = [d for d in range(truth.shape[-1] - 7) if d not in {int(h) for h in humanoid.hand_dofs}]
    dof_names = [f"{joint.name}_{k}" for joint in humanoid.skeleton.joints[1:] for k in range(len(joint.dofs))]
    shown, written = config["video"]["takes"], []
    for w, (window, label) in enumerate(zip(windows, labels, strict=True)):
        folder = out / "windows" / file_name(label)
        folder.mkdir(parents=True, exist_ok=True)
        motions = {"forecast": mean.qpos[w, 0], "reference": truth[w]}
        motions |= {} if drawn is None else {f"future_{k}": drawn.qpos[w, k] for k in range(min(3, len(drawn.qpos[w])))}
        for name, qpos in motions.items():
            write_motion_files(folder, name, Motion(humanoid.skeleton, qpos, fps, f"{label} {name}"))
        for name, reported in others.items():
            write_motion(Motion(humanoid.skeleton, reported[w], fps, f"{label} {name}"), folder / other_file(name))
        if (video := videos[window.take]) is not None:
            write_footage(folder, video, window.now + 1, fps)
        if bands is not None:
            edges = {"low": bands.low[w], "median": bands.median[w], "high": bands.high[w]}
            columns = {f"{dof_names[d]}_{edge}": v[:, i] for i, d in enumerate(used) for edge, v in edges.items()}
            write_columns_csv(folder / "bands.csv", columns)
        if shown is not None and w >= shown:
            continue
        around = np.zeros((0, *truth[w].shape)) if drawn is None else drawn.qpos[w, :3]
        path = folder / "futures.mp4"
        size = int(config["video"]["size"])
        report.write_futures_video(path, humanoid, window, mean.qpos[w, 0], truth[w], around, video, size)
        written.append(path)
    return written
