"""From a configuration to a trained method of another paper: ERD, acLSTM, PathPose; what ``egopose.baseline`` runs."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from egopose.checkpoint import checkpoint as checkpoints
from egopose.checkpoint.resume import continued_job, finished, mark_finished
from egopose.core.atomic_write import write_text_whole
from egopose.core.errors import InputError
from egopose.data.fragments import FragmentLike
from egopose.data.preparation import fingerprint_of, flow_name, global_spans, store_folder
from egopose.data.spans import Span
from egopose.data.splits import split_takes
from egopose.data.store import TakeStore
from egopose.data.windows import ForecastWindow
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.state_layout import StateLayout
from egopose.models.baselines.path_pose import PathPose
from egopose.models.baselines.recurrent import RecurrentForecaster
from egopose.models.mirror import state_mirror
from egopose.models.pose_regression import integrate_root, pose_regression, split_state, state_to_qpos
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.pipeline.dataset import PreparedData
from egopose.tasks.dataset import Dataset, require_same_store
from egopose.training.fitting import Fit, FitResult, FitSettings, State, fit
from egopose.training.logging import write_provenance
from egopose.training.loop import stop_signals
from egopose.training.path_pose import PathPoseLearner, PathPoseSettings, build_path_pose
from egopose.training.recurrent_baselines import RecurrentLearner, RecurrentSettings, build_forecaster

KINDS = ("recurrent", "path_pose")
RESULT = "baseline.json"


def run_baseline(
    config: Mapping[str, Any], folder: Path, checkpoint: Path | None = None, dataset: Dataset | None = None
) -> FitResult:
    """Train the baseline ``config`` names in the run directory ``folder``; keeps the last checkpoint and one before.

    Args:
        config: resolved ``conf/baseline.yaml``.
        folder: the run directory.
        checkpoint: to go on from, None for a new run.
        dataset: None for what ``config`` names.

    Raises:
        InputError: the configuration, the data or the checkpoint do not fit.
    """
    if dataset is None:
        if checkpoint is not None:
            require_same_store(folder, fingerprint_of(config))
        dataset = PreparedData(config, None if checkpoint is None else folder).seen_motions()
    dataset.keep_regressor(folder)
    dataset.keep_provenance(folder)
    settings = FitSettings.from_config(config["baseline"]["optimiser"])
    learner = _learner(config, dataset, settings)
    training = config["training"]
    saved: State | None = None
    if checkpoint is not None:
        saved = {}
        checkpoints.RunCheckpoint({"training": checkpoints.ComponentState(dict, saved.update)}).restore(
            checkpoint, {"training"}
        )

    with stop_signals() as stop:
        result = fit(
            learner,
            settings,
            int(config["seed"]),
            int(training["total_steps"]),
            None if training["max_seconds"] is None else float(training["max_seconds"]),
            _Saver(config, folder),
            saved,
            stop,
        )
    if result.reason == "interrupted":
        return result
    if isinstance(learner, PathPoseLearner):
        learner.choose_weight()
    _save_model(learner.model, config, folder, result)
    curve = [{"frames": f, "loss": _number(a), "held_out": _number(b)} for f, a, b in result.history]
    write_text_whole(folder / RESULT, json.dumps({"reason": result.reason, "curve": curve}, indent=1))
    mark_finished(folder, config, {"reason": result.reason, "iteration": result.steps, "score": _score(result)})
    return result


def run_baseline_job(config: dict[str, Any], folder: Path) -> None:
    """Train the rest of ``folder``, from its last checkpoint; a finished one is left as it is.

    Raises:
        InputError: as :func:`run_baseline`; the directory is that of another job.
    """
    checkpoint = continued_job(folder, config)
    if (done := finished(folder, config)) is not None:
        print(f"{folder}: {done['reason']} already after {done['iteration']} steps", flush=True)
        return
    write_provenance(folder, config)
    print(f"run directory: {folder}", flush=True)
    result = run_baseline(config, folder, checkpoint)
    print(
        f"{result.reason}: {result.steps} steps, {result.frames} frames, held-out error {result.held_out:.4f}",
        flush=True,
    )
    if result.reason == "interrupted":
        print(f"go on with: python -m egopose.baseline resume={folder}", flush=True)
        raise SystemExit(130)


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _score(result: FitResult) -> float:
    """Larger is better, and a number: JSON knows no NaN."""
    return -result.held_out if math.isfinite(result.held_out) else 0.0


class _Saver:
    """Checkpoints of a training, named after the frames learned from: one every minute and one at the end."""

    every = 60.0

    def __init__(self, config: Mapping[str, Any], folder: Path) -> None:
        self.config, self.folder, self.last = config, folder, time.monotonic()

    def __call__(self, work: Fit) -> None:
        result = work.result
        if not result.reason and time.monotonic() - self.last < self.every:
            return
        if (self.folder / checkpoints.FOLDER / f"checkpoint-{result.frames:012d}").exists():
            return
        component = checkpoints.ComponentState(work.state, lambda _: None)
        made = checkpoints.RunCheckpoint({"training": component, "config": dict(self.config)})
        kind = f"baseline {_kind(self.config)}"
        metadata = checkpoints.metadata_of(kind, 0, result.steps, result.frames, _score(result))
        checkpoints.rotation(self.folder, keep_last=2).save(made, step=result.frames, metadata=metadata)
        self.last = time.monotonic()


def _save_model(model: nn.Module, config: Mapping[str, Any], folder: Path, result: FitResult) -> None:
    """``folder/model``: the weights that were best on held-out frames, and what they were made with."""
    sizes = {key: list(value.shape) for key, value in model.state_dict().items()}
    about = {"baseline": config["baseline"], "sizes": sizes, "vision": config["vision"]}
    metadata = checkpoints.metadata_of(f"baseline {_kind(config)}", 0, result.steps, result.frames, _score(result))
    checkpoints.RunCheckpoint({"model": model, "config": about}).save(folder / "model", metadata=metadata)


def _kind(config: Mapping[str, Any]) -> str:
    kind = str(config["baseline"].get("kind"))
    if kind not in KINDS:
        raise InputError("conf/baseline", "kind", f"must be one of {', '.join(KINDS)}, not {kind!r}")
    return kind


def _own_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in ("kind", "optimiser")}


def _learner(config: Mapping[str, Any], dataset: Dataset, settings: FitSettings) -> RecurrentLearner | PathPoseLearner:
    store = TakeStore.open(store_folder(config))
    # Kinematic methods need no floor: they may learn from every training frame, as the state regressor does.
    pieces = split_takes(store.takes, config["data"]["split"], "train", supported_only=False)
    spans = [Span(*span) for span in global_spans(store, pieces)]
    states = humanoid_state(dataset.reference).float()
    seed, own = int(config["seed"]), _own_settings(config["baseline"])
    if _kind(config) == "recurrent":
        poses = states[:, StateLayout.of_size(states.shape[1]).pose]
        recurrent = RecurrentSettings.from_config(own)
        mirror = state_mirror(dataset.humanoid.skeleton).poses() if recurrent.mirror else None
        return RecurrentLearner(poses, spans, recurrent, settings.batch, settings.validation_share, seed, mirror)
    path = PathPoseSettings.from_config(own)
    flow = store.flow(flow_name(config))
    return PathPoseLearner(flow, states, spans, path, settings.batch, settings.validation_share, seed)


@dataclass(frozen=True)
class Baseline:
    """A trained method, in evaluation mode, and the settings it was made with."""

    model: RecurrentForecaster | PathPose
    settings: RecurrentSettings | PathPoseSettings


def load_baseline(run: str | Path) -> Baseline:
    """The trained model of a run directory.

    Raises:
        InputError: the run has not come to its end, its model is damaged, or it is of another kind; names the field.
    """
    folder = Path(run) / "model"
    if not folder.is_dir():
        raise InputError(folder, "model", "is missing: the baseline has not been trained to its end")
    about = checkpoints.read_json(folder, "config")
    if not isinstance(about, dict) or not {"baseline", "sizes"} <= set(about):
        raise InputError(folder, "config", "this is no baseline")
    own, sizes = _own_settings(about["baseline"]), about["sizes"]
    model: RecurrentForecaster | PathPose
    settings: RecurrentSettings | PathPoseSettings
    if _kind(about) == "recurrent":
        settings = RecurrentSettings.from_config(own)
        model = build_forecaster(settings, torch.zeros(sizes["mean"][0]), torch.ones(sizes["mean"][0]), 0)
    else:
        settings = PathPoseSettings.from_config(own)
        model = build_path_pose(settings, *sizes["centres"])
    checkpoints.RunCheckpoint({"model": model}).restore(folder, {"model"})
    model.eval()
    return Baseline(model, settings)


def path_pose_motion(model: PathPose, flow: Any, dataset: Dataset, fragment: FragmentLike, name: str = "") -> Motion:
    """The motion PathPose finds in a fragment's flow, placed where the reference begins; roots as PoseReg's.

    Args:
        model: trained.
        flow: ``[F, 2, S, S]`` of the store.
        dataset: of the same store.
        fragment: in frames of its take.
        name: of the motion.
    """
    rows = _rows(dataset, fragment)
    return _placed(model.states(flow[rows]).numpy(), dataset, rows, name)


def regressed_motion(dataset: Dataset, fragment: FragmentLike, name: str = "") -> Motion:
    """PoseReg's motion of a fragment."""
    rows = _rows(dataset, fragment)
    assert dataset.states is not None
    return _placed(dataset.states[rows].numpy(), dataset, rows, name)


def _rows(dataset: Dataset, fragment: FragmentLike) -> slice:
    offset = int(dataset.takes.offsets[fragment.take])
    return slice(offset + fragment.start, offset + fragment.stop)


def _placed(states: Array, dataset: Dataset, rows: slice, name: str) -> Motion:
    humanoid = dataset.humanoid
    first: Array = torch.as_tensor(dataset.reference["qpos"][rows.start]).double().numpy()
    start, heading, fps = first[:2], rot.heading(first[3:7]), 1.0 / humanoid.control_dt
    return pose_regression(states, humanoid.skeleton, start, heading, fps, humanoid.joint_range, name)


def forecast_qpos(
    model: RecurrentForecaster, contexts: Tensor, dataset: Dataset, windows: Sequence[ForecastWindow]
) -> Array:
    """The futures ``[W, H, nq]`` of windows, from PoseReg's poses of the frames seen; roots integrated from there.

    Args:
        model: trained.
        contexts: ``[W, context, S]`` humanoid states z, see :func:`egopose.inference.context_states.context_states`.
        dataset: for where the windows begin.
        windows: all of one context and horizon.
    """
    humanoid, size = dataset.humanoid, len(model.mean)
    fps, out = 1.0 / humanoid.control_dt, []
    poses = contexts[:, :, :size].float()
    futures = torch.cat([model.forecast(part, windows[0].horizon) for part in poses.split(64)])
    for window, clip in zip(windows, torch.cat([poses, futures], dim=1).double().numpy(), strict=True):
        # Neither the integration nor qpos reads joint velocities.
        states = np.concatenate([clip, np.zeros((len(clip), contexts.shape[-1] - size))], axis=1)
        first: Array = torch.as_tensor(dataset.reference["qpos"][_rows(dataset, window).start]).double().numpy()
        parts = split_state(states, humanoid.joint_range)
        position, heading = integrate_root(parts, first[:2], rot.heading(first[3:7]), fps)
        qpos, _ = state_to_qpos(states, position, heading, humanoid.joint_range)
        out.append(qpos[window.context :])
    return np.stack(out)
