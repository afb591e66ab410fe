"""The state regressor F of a store: trained once for a configuration, its predictions kept as a table of the store.

Two places hold the result: ``STORE/tables/NAME`` (predictions on every frame) and ``STORE/regressors/NAME`` (the
weights, in the checkpoint format), NAME being a fingerprint of all that F depends on. While F is being trained,
``STORE/regressors/NAME.part`` holds the state to resume from after an interruption.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from egopose.checkpoint.checkpoint import ComponentState, RunCheckpoint, metadata_of, read_json, verify
from egopose.checkpoint.checksums import CHECKSUMS
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.safe_io import read_json as read_json_file
from egopose.data.lock import store_lock
from egopose.data.preparation import global_spans
from egopose.data.spans import Span, cross_fit_blocks, group_blocks, without_block
from egopose.data.splits import split_takes
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.blended import blended_regressor
from egopose.models.kernel_regression import KernelRegression
from egopose.models.mirror import state_mirror
from egopose.models.predictions import Flow, predict_takes
from egopose.models.regressor import StateRegressor
from egopose.models.regressor_settings import RegressorSettings
from egopose.pipeline.regressor_input import body_part_estimator_name, body_part_fingerprint, seen_in_store
from egopose.training.blended_regressor import KernelSettings, blend
from egopose.training.past_contexts import past_contexts
from egopose.training.regressor import Progress, State, TrainingResult, build_regressor, train_regressor
from egopose.vision.encoders import build_encoder

TABLE_KEYS = ("humanoid_state", "visual_context", "visual_features", "joint_targets")


def regressor_name(config: Mapping[str, Any], store: TakeStore, flow_name: str) -> str:
    """``regressor-`` and a fingerprint of video, network, training, split and reference."""
    parts = [store.fingerprint, flow_name, config["vision"]["encoder"], config["regressor"], config["data"]["split"]]
    if _by_subject(config):
        parts.append("cross-fitted by subject")
    finder = body_part_estimator_name(config["regressor"])
    if finder is not None:
        parts.append(body_part_fingerprint(finder))
    return "regressor-" + hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def regressor_tables(
    config: Mapping[str, Any], store: TakeStore, humanoid: HumanoidModel, flow_name: str
) -> tuple[TensorDict, Path]:
    """F's predictions for every frame of the store; F is trained if it has not been yet.

    Returns:
        TensorDict ``[F]`` with ``humanoid_state [S]`` (z in its own units), ``visual_context [C]``,
        ``visual_features [D]`` and ``joint_targets [nu]`` (rad, within the joints' range); and the folder of weights.

    Raises:
        InputError: the store lacks flow, or a setting is wrong.
    """
    name = regressor_name(config, store, flow_name)
    weights = store.root / "regressors" / name
    if not _is_trained(store, name):
        network = _network_config(config)
        if network is not None:
            _kernel_settings(config)  # what is wrong with it is said before a network is trained
            regressor_tables(network, store, humanoid, flow_name)
        with store_lock(store.root):
            if not _is_trained(store, name):  # by the process this one waited for
                if network is None:
                    _train(config, store, humanoid, flow_name, name, weights)
                else:
                    _blend(config, network, store, humanoid, flow_name, name)
    return store.table(name), weights


def kept_tables(
    config: Mapping[str, Any], store: TakeStore, humanoid: HumanoidModel, flow_name: str, weights: Path
) -> tuple[TensorDict, Path]:
    """As :func:`regressor_tables`, with the F that a run was trained with; nothing is trained.

    If the store has a table made by the same weights, it is read. Else F predicts again, and the store is not changed.

    Args:
        config: of the run, resolved.
        store: with flow.
        humanoid: of the run.
        flow_name: the flow's name in the store.
        weights: ``RUN_DIR/regressor``. If there is none, the store's F for ``config`` is taken.

    Raises:
        InputError: neither the run nor the store holds an F, its weights are damaged, or the store lacks flow.
    """
    if not weights.is_dir():
        name = regressor_name(config, store, flow_name)
        if not _is_trained(store, name):
            raise InputError(weights, "regressor", f"is missing, and the store {store.root} holds none of this run's")
        return store.table(name), store.root / "regressors" / name
    verify(weights)
    wanted = _weights_checksums(weights)
    for folder in sorted((store.root / "regressors").glob("*")):
        name = folder.name
        made_by_it = _is_trained(store, name) and _weights_checksums(folder) == wanted
        if made_by_it and store.table_card(name).get("flow") == flow_name:
            return store.table(name), weights
    model, source_config = load_regressor(weights)
    size = humanoid_state(store.reference[:1]).shape[1]
    if source_config["state_size"] != size:
        raise InputError(
            weights, "state_size", f"is {source_config['state_size']}, the store's states have {size} numbers"
        )
    print(f"predicting {store.frames_total} frames with {weights}", file=sys.stderr, flush=True)
    seen = seen_in_store(config, source_config["regressor"], store, flow_name)
    return TensorDict(_predict(model, store, humanoid, seen, _settings(source_config)), [store.frames_total]), weights


def _network_config(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """Of the F that a blended one is made of, which is an F of the store by itself; None where none is blended."""
    regressor = config["regressor"]
    if regressor.get("kernel") is None:
        return None
    return {**config, "regressor": {key: value for key, value in regressor.items() if key != "kernel"}}


def _by_subject(config: Mapping[str, Any]) -> bool:
    """If people are held out for testing, cross-fitting holds out people too: F does far better on people it knows."""
    return config["data"]["split"]["kind"] in ("subject", "table") and int(config["regressor"]["cross_fit"]) > 1


def _is_trained(store: TakeStore, name: str) -> bool:
    return store.has_table(name) and (store.root / "regressors" / name / "manifest.json").is_file()


def _weights_checksums(folder: Path) -> dict[str, str]:
    """Of the tensors and the settings they belong to; the manifest beside them also tells when they were saved."""
    try:
        result = read_json_file(folder / CHECKSUMS, CHECKSUMS)
    except (OSError, ValueError) as error:
        raise InputError(folder, CHECKSUMS, f"cannot be read: {error}") from None
    return {file: digest for file, digest in result.items() if file.startswith("components/")}


def _predict(
    model: StateRegressor, store: TakeStore, humanoid: HumanoidModel, seen: Flow, settings: RegressorSettings
) -> dict[str, Tensor]:
    tables = predict_takes(model, seen, _whole_takes(store), settings)
    return _with_targets(model, tables, humanoid, settings)


def _with_targets(
    model: StateRegressor, tables: dict[str, Tensor], humanoid: HumanoidModel, settings: RegressorSettings
) -> dict[str, Tensor]:
    """``tables`` with what the environment reads beside the predictions themselves."""
    if settings.cross_fit > 1:
        # The contexts of several fits do not share their axes; the states they are decoded to do.
        tables["visual_context"] = model.normalise(tables["humanoid_state"])
    tables["joint_targets"] = joint_targets(tables["humanoid_state"], humanoid)
    return {key: tables[key] for key in TABLE_KEYS}


def _train(
    config: Mapping[str, Any], store: TakeStore, humanoid: HumanoidModel, flow_name: str, name: str, weights: Path
) -> None:
    settings = _settings(config)
    flow = store.flow(flow_name)
    states = humanoid_state(store.reference).float()
    fragments = _training_spans(config, store)
    mirror = state_mirror(humanoid.skeleton) if settings.mirror else None
    weights.parent.mkdir(parents=True, exist_ok=True)
    parts: list[Path] = []

    def fit(spans: list[Span], label: str) -> tuple[StateRegressor, TrainingResult]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            encoder = build_encoder(config["vision"]["encoder"])
        model = build_regressor(encoder, states, spans, settings, encoder.features)
        frames = sum(f.stop - f.start for f in spans)
        print(f"training the state regressor{label.replace('.', ' ')} on {frames} frames", file=sys.stderr, flush=True)
        parts.append(weights.with_name(f"{weights.name}{label}.part"))
        saved = _load_part(parts[-1])
        return model, train_regressor(
            model, flow, states, spans, settings, mirror, _report, partial(_save_part, parts[-1]), saved
        )

    model, result = fit(fragments, "")
    tables = _predict(model, store, humanoid, flow, settings)
    if settings.cross_fit > 1:
        for number, block in enumerate(_blocks(config, store)):
            others = without_block(fragments, block, settings.margin, settings.margin)
            seen = _predict(fit(others, f".fold{number}")[0], store, humanoid, flow, settings)
            for key in ("humanoid_state", "visual_features", "joint_targets"):
                for span in block:
                    tables[key][span.start : span.stop] = seen[key][span.start : span.stop]
        tables = _with_targets(model, tables, humanoid, settings)
    # JSON knows no NaN: nothing was held out, nothing is known.
    errors = {
        key: None if math.isnan(value) else value
        for key, value in (("validation_mse", result.validation_mse), ("mean_mse", result.mean_mse))
    }
    card = {"flow": flow_name, "best_epoch": result.best_epoch, **errors}
    sizes = {"state_size": states.shape[1], "vision": config["vision"], "regressor": config["regressor"]}
    _keep(store, name, model, tables, sizes, card)
    for part in parts:
        shutil.rmtree(part, ignore_errors=True)


def _keep(
    store: TakeStore,
    name: str,
    model: StateRegressor,
    tables: dict[str, Tensor],
    sizes: dict[str, Any],
    card: dict[str, Any],
) -> None:
    """Weights and table together, never weights beside a table that others made."""
    shutil.rmtree(store.root / "tables" / name, ignore_errors=True)
    RunCheckpoint({"regressor": model, "config": sizes}).save(
        store.root / "regressors" / name,
        metadata=metadata_of("regressor", sizes["state_size"], card["best_epoch"], 0, 0.0),
    )
    store.write_table(name, tables, card)


def _whole_takes(store: TakeStore) -> list[Span]:
    return [Span(t.offset, t.offset + t.length) for t in store.takes]


def _training_spans(config: Mapping[str, Any], store: TakeStore) -> list[Span]:
    pieces = split_takes(store.takes, config["data"]["split"], "train", supported_only=False)
    return [Span(*span) for span in global_spans(store, pieces)]


def _blocks(config: Mapping[str, Any], store: TakeStore) -> list[list[Span]]:
    """The training frames, divided into one list a cross-fit."""
    folds = _settings(config).cross_fit
    pieces = split_takes(store.takes, config["data"]["split"], "train", supported_only=False)
    fragments = _training_spans(config, store)
    subjects = [store.takes[piece.take].subject for piece in pieces]
    if _by_subject(config) and len(set(subjects)) > 1:
        return group_blocks(fragments, subjects, folds)
    return cross_fit_blocks(fragments, folds)


def _blend(
    config: Mapping[str, Any],
    network_config: Mapping[str, Any],
    store: TakeStore,
    humanoid: HumanoidModel,
    flow_name: str,
    name: str,
) -> None:
    """From a cross-fitted F of the store to a blended one, its tables cross-fitted likewise."""
    settings = _settings(config)
    network_name = regressor_name(network_config, store, flow_name)
    network, source_config = load_regressor(store.root / "regressors" / network_name)
    seen = seen_in_store(config, config["regressor"], store, flow_name, keep=True)
    print(f"blending a kernel regression with {network_name}", file=sys.stderr, flush=True)
    blended = blend(
        network,
        store.table(network_name)["humanoid_state"],
        seen,
        humanoid_state(store.reference),
        _whole_takes(store),
        _training_spans(config, store),
        _blocks(config, store),
        humanoid,
        settings,
        _kernel_settings(config),
    )
    print(f"shares of network and kernel: {blended.shares}", file=sys.stderr, flush=True)
    tables = _predict(blended.model, store, humanoid, seen, settings)
    for span in _training_spans(config, store):
        tables["humanoid_state"][span.start : span.stop] = blended.crossed[span.start : span.stop]
    tables = _with_targets(blended.model, tables, humanoid, settings)
    centres = len(blended.kernels[0].centres)
    axes = [kernel.centres.shape[1] for kernel in blended.kernels]
    sizes = {**source_config, "regressor": config["regressor"], "centres": centres, "axes": axes}
    finder = body_part_estimator_name(config["regressor"])
    if finder is not None:
        sizes["finder"] = body_part_fingerprint(finder)
    card = {**store.table_card(network_name), "shares": blended.shares, "centres": centres}
    _keep(store, name, blended.model, tables, sizes, card)


def training_contexts(
    config: Mapping[str, Any],
    store: TakeStore,
    humanoid: HumanoidModel,
    flow_name: str,
    starts: Tensor,
    context: int,
) -> Tensor:
    """States z ``[N, context, S]`` that a store's regressor, blind to those frames, sees up to each of them.

    Those of a blended regressor are :func:`egopose.training.past_contexts.past_contexts`; of a network alone they are
    its cross-fitted states of the whole takes.

    Args:
        config: resolved; whose regressor is trained already.
        store: with flow.
        humanoid: whose states they are.
        flow_name: the flow's name in the store.
        starts: ``[N]`` training frames, the contexts' last.
        context: frames.

    Raises:
        InputError: the regressor is not there or damaged.
    """
    tables, weights = regressor_tables(config, store, humanoid, flow_name)
    network_config = _network_config(config)
    if network_config is None:
        return tables["humanoid_state"][starts[:, None] + torch.arange(1 - context, 1)].float()
    print(f"regressing {len(starts)} contexts", file=sys.stderr, flush=True)
    return past_contexts(
        load_regressor(weights)[0],
        store.table(regressor_name(network_config, store, flow_name))["humanoid_state"],
        seen_in_store(config, config["regressor"], store, flow_name, keep=True),
        humanoid_state(store.reference),
        _whole_takes(store),
        _training_spans(config, store),
        _blocks(config, store),
        humanoid,
        _settings(config),
        _kernel_settings(config),
        starts,
        context,
    )


def _save_part(part: Path, state: State) -> None:
    component = ComponentState(lambda: state, lambda _: None)
    epoch = int(state["counters"][0])
    RunCheckpoint({"training": component}).save(part, metadata=metadata_of("regressor training", 0, epoch, 0, 0.0))


def _load_part(part: Path) -> State | None:
    """The state that :func:`_save_part` left; None if training starts from the beginning. Raises InputError: it is
    damaged."""
    if not part.is_dir():
        return None
    state: State = {}
    result = RunCheckpoint({"training": ComponentState(dict, state.update)}).restore(part)
    print(f"going on after epoch {result['iteration']}, saved in {part}", file=sys.stderr, flush=True)
    return state


def _settings(config: Mapping[str, Any]) -> RegressorSettings:
    own = _network_config(config) or config
    return from_mapping(RegressorSettings, own["regressor"], "conf/regressor")


def _kernel_settings(config: Mapping[str, Any]) -> KernelSettings:
    if _settings(config).cross_fit < 2:
        raise InputError("regressor", "cross_fit", "must be at least 2 where a kernel is blended in")
    return from_mapping(KernelSettings, config["regressor"]["kernel"], "conf/regressor kernel")


def load_regressor(weights: str | Path) -> tuple[StateRegressor, dict[str, Any]]:
    """A trained F, in evaluation mode, and the groups ``vision`` and ``regressor`` it was made with.

    Args:
        weights: ``STORE/regressors/NAME``, or ``RUN_DIR/regressor``.

    Raises:
        InputError: the folder is damaged or of another kind, or was made with another body-part estimator.
    """
    folder = Path(weights)
    config = read_json(folder, "config")
    if "state_size" not in config:
        raise InputError(folder, "config", "this is no state regressor")
    size = int(config["state_size"])
    encoder = build_encoder(config["vision"]["encoder"])
    settings = _settings(config)
    # The statistics come with the weights; two frames of zeros replace the frames they were computed from.
    model = build_regressor(encoder, torch.zeros(2, size), [Span(0, 2)], settings, encoder.features)
    if _network_config(config) is not None:
        kernel = _kernel_settings(config)
        windows = kernel.windows()
        inputs, centres = kernel.input_sizes(), int(config["centres"])
        # One number where it was made before there could be several kernels.
        axes = config["axes"] if isinstance(config["axes"], list) else [config["axes"]]
        blank = [KernelRegression(seen, int(kept), centres, size) for seen, kept in zip(inputs, axes, strict=True)]
        model = blended_regressor(model, blank, kernel.cells, windows, kernel.limb_numbers)
    RunCheckpoint({"regressor": model}).restore(folder)
    finder = body_part_estimator_name(config["regressor"])
    if finder is not None and config.get("finder") not in (None, body_part_fingerprint(finder)):
        raise InputError(
            folder, "finder", f"it was made with another body-part estimator {finder!r} than this egopose has"
        )
    return model.eval(), config


def joint_targets(states: Tensor, humanoid: HumanoidModel) -> Tensor:
    """Joint angles ``[F, nu]`` rad of humanoid states ``[F, 2 nq - 3]``, within the joints' range."""
    limits = torch.as_tensor(humanoid.joint_range, dtype=states.dtype)
    return states[:, StateLayout(len(limits)).joint_angles].clamp(limits[:, 0], limits[:, 1])


def _report(progress: Progress) -> None:
    print(
        f"regressor epoch {progress.epoch}/{progress.epochs}  train {progress.train_mse:.3f}  "
        f"held out {progress.validation_mse:.3f}  left {progress.eta_seconds:.0f} s",
        file=sys.stderr,
        flush=True,
    )
