"""The state regressor F of a store: trained once for a configuration, its predictions kept as a table of the store.

Two places hold what came of it: ``STORE/tables/NAME`` (predictions on every frame) and ``STORE/regressors/NAME`` (the
weights, in the checkpoint format), NAME being a fingerprint of all that F depends on.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from egopose.config import from_mapping
from egopose.data.splits import split_takes
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.errors import InputError
from egopose.humanoid.model import HumanoidModel
from egopose.models.mirror import state_mirror
from egopose.models.regressor import StateRegressor
from egopose.training.checkpoint import RunCheckpoint, metadata_of, read_json
from egopose.training.fragments import Span
from egopose.training.predictions import predict_takes
from egopose.training.regressor_settings import RegressorSettings
from egopose.training.supervised import Progress, build_regressor, train_regressor
from egopose.vision.encoders import build_encoder

TABLE_KEYS = ("humanoid_state", "visual_context", "visual_features", "joint_targets")


def regressor_name(config: Mapping[str, Any], store: TakeStore, flow_name: str) -> str:
    """``regressor-`` and a fingerprint of video, network, training, split and reference."""
    parts = [store.fingerprint, flow_name, config["vision"]["encoder"], config["regressor"], config["data"]["split"]]
    return "regressor-" + hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def regressor_tables(
    config: Mapping[str, Any], store: TakeStore, humanoid: HumanoidModel, flow_name: str
) -> tuple[TensorDict, Path]:
    """F's predictions for every frame of the store; F is trained where that has not been done.

    Returns:
        TensorDict ``[F]`` with ``humanoid_state [S]`` (z in its own units), ``visual_context [C]``,
        ``visual_features [D]`` and ``joint_targets [nu]`` (rad, within the joints' range); and the folder of weights.

    Raises:
        InputError: the store lacks flow, or a setting is wrong.
    """
    name = regressor_name(config, store, flow_name)
    weights = store.root / "regressors" / name
    if not (store.has_table(name) and (weights / "manifest.json").is_file()):
        _train(config, store, humanoid, flow_name, name, weights)
    return store.table(name), weights


def _train(
    config: Mapping[str, Any], store: TakeStore, humanoid: HumanoidModel, flow_name: str, name: str, weights: Path
) -> None:
    settings = _settings(config)
    flow = store.flow(flow_name)
    states = humanoid_state(store.reference).float()
    fragments = [
        Span(store.takes[f.take].offset + f.start, store.takes[f.take].offset + f.stop)
        for f in split_takes(store.takes, config["data"]["split"], "train", supported_only=False)
    ]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        encoder = build_encoder(config["vision"]["encoder"])
    model = build_regressor(encoder, states, fragments, settings, encoder.features)
    mirror = state_mirror(humanoid.skeleton) if settings.mirror else None
    frames = sum(f.stop - f.start for f in fragments)
    print(f"training the state regressor on {frames} frames", file=sys.stderr, flush=True)
    result = train_regressor(model, flow, states, fragments, settings, mirror, _report)
    whole = [Span(t.offset, t.offset + t.length) for t in store.takes]
    tables = predict_takes(model, flow, whole, settings)
    tables["joint_targets"] = joint_targets(tables["humanoid_state"], humanoid)
    # JSON knows no NaN: nothing was held out, nothing is known.
    errors = {
        key: None if math.isnan(value) else value
        for key, value in (("validation_mse", result.validation_mse), ("mean_mse", result.mean_mse))
    }
    card = {"flow": flow_name, "best_epoch": result.best_epoch, **errors}
    sizes = {"state_size": states.shape[1], "vision": config["vision"], "regressor": config["regressor"]}
    weights.parent.mkdir(parents=True, exist_ok=True)
    RunCheckpoint({"regressor": model, "config": sizes}).save(
        weights, metadata=metadata_of("regressor", states.shape[1], result.best_epoch, 0, 0.0)
    )
    store.write_table(name, {key: tables[key] for key in TABLE_KEYS}, card)


def _settings(config: Mapping[str, Any]) -> RegressorSettings:
    return from_mapping(RegressorSettings, config["regressor"], "conf/regressor")


def load_regressor(weights: str | Path) -> tuple[StateRegressor, dict[str, Any]]:
    """A trained F, in evaluation mode, and the groups ``vision`` and ``regressor`` it was made with.

    Args:
        weights: ``STORE/regressors/NAME``, or ``RUN_DIR/regressor``.

    Raises:
        InputError: the folder is damaged or of another kind.
    """
    folder = Path(weights)
    config = read_json(folder, "config")
    if "state_size" not in config:
        raise InputError(folder, "config", "this is no state regressor")
    size = int(config["state_size"])
    encoder = build_encoder(config["vision"]["encoder"])
    settings = _settings(config)
    # The statistics come with the weights; two frames of zeros stand in for the frames they were taken from.
    model = build_regressor(encoder, torch.zeros(2, size), [Span(0, 2)], settings, encoder.features)
    RunCheckpoint({"regressor": model}).restore(folder)
    return model.eval(), config


def joint_targets(states: Tensor, humanoid: HumanoidModel) -> Tensor:
    """Joint angles ``[F, nu]`` rad of humanoid states ``[F, 2 nq - 3]``, within the joints' range."""
    limits = torch.as_tensor(humanoid.joint_range, dtype=states.dtype)
    return states[:, 5 : 5 + len(limits)].clamp(limits[:, 0], limits[:, 1])


def _report(progress: Progress) -> None:
    print(
        f"regressor epoch {progress.epoch}/{progress.epochs}  train {progress.train_mse:.3f}  "
        f"held out {progress.validation_mse:.3f}  left {progress.eta_seconds:.0f} s",
        file=sys.stderr,
        flush=True,
    )
