"""From a configuration to the kinematic forecasts a policy follows: trained once a run, kept in ``RUN_DIR/forecaster``.

Forecasts that begin at training frames are those of networks that have not seen the frames around them, nor any they
forecast: a policy must not trust them more than it may on new takes.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from egopose.data.preparation import global_spans, store_folder
from egopose.data.splits import split_takes
from egopose.data.store import TakeStore
from egopose.envs.futures import Futures
from egopose.envs.mdp.observations import humanoid_state
from egopose.errors import InputError
from egopose.evaluation.forecasting import ForecastWindow
from egopose.humanoid.soles import out_of_floor
from egopose.inference.forecaster import placed_states
from egopose.material import Material
from egopose.models.motion_forecast import MotionForecaster, spline_basis
from egopose.training.baselines import FitSettings, fit
from egopose.training.checkpoint import ComponentState, RunCheckpoint, has_component, metadata_of
from egopose.training.fragments import Span, cross_fit_blocks, group_blocks
from egopose.training.motion_forecast import ForecasterSettings, ForecastLearner, build_forecaster, cross_fit_starts

if TYPE_CHECKING:
    from egopose.pipeline import Agent

FOLDER = "forecaster"


def with_futures(config: Mapping[str, Any], material: Material, run: Path) -> Material:
    """The material with the run's forecasts, trained where that has not been done.

    Itself where the run has no forecaster, or the material has forecasts already.

    Args:
        config: resolved; its group ``forecaster`` says how, or is null.
        material: with the states a regressor sees.
        run: the run directory.

    Raises:
        InputError: a setting is wrong, there are no regressed states, or what is kept is damaged.
    """
    if config.get("forecaster") is None or material.futures is not None:
        return material
    settings, _ = _settings(config)
    folder = run / FOLDER
    if not folder.is_dir():
        _train(config, material, folder)
    saved: dict[str, Tensor] = {}
    if has_component(folder, "futures"):
        RunCheckpoint({"futures": ComponentState(dict, saved.update)}).restore(folder, {"futures"})
    else:  # shipped without those of its training frames: others are put in where a forecast begins
        assert material.states is not None
        knots, size = spline_basis(settings.horizon + 1, settings.spacing, _fps(material))[0].shape[1], _size(material)
        saved = {"coefficients": torch.zeros(0, knots, size), "starts": torch.zeros(0, dtype=torch.int64)}
    return replace(material, futures=_futures(material, settings, saved["coefficients"], saved["starts"]))


def begin_forecasts(agent: Agent, windows: Sequence[ForecastWindow], pasts: Tensor) -> tuple[Tensor, Tensor]:
    """Where forecasts of ``windows`` begin: ``qpos [W, nq]`` and ``qvel [W, nv]``, placed where the reference is, feet
    out of the floor.

    That is the last state of ``pasts [W, context, S]``; where the agent follows kinematic forecasts, it is where those
    begin, and from now on the agent follows, from these frames, the ones that have seen ``pasts`` alone.
    """
    material = agent.material
    now = torch.tensor([int(material.takes.offsets[w.take]) + w.now for w in windows])
    where = torch.as_tensor(material.reference["qpos"][now]).double()
    humanoid = material.humanoid
    if material.futures is None:
        return placed_states(pasts[:, -1].numpy(), where.numpy(), humanoid)
    curves = ForecastCurves(agent.config, material, agent.path.resolve().parent.parent)
    material.futures.put(curves(pasts), now)
    qpos, qvel = material.futures.first_state(now, where, humanoid.joint_range)
    return torch.from_numpy(out_of_floor(humanoid, qpos.numpy())), qvel


def still_futures(config: Mapping[str, Any], material: Material) -> Material:
    """The material with forecasts of a body that stays as it is in the first frame."""
    assert material.states is not None
    settings, _ = _settings(config)
    knots = spline_basis(settings.horizon + 1, settings.spacing, _fps(material))[0].shape[1]
    # The splines add up to one everywhere.
    frames = len(material.reference)
    curves = material.states[:1, None, : _size(material)].expand(frames, knots, -1)
    return replace(material, futures=_futures(material, settings, curves, torch.arange(frames)))


class ForecastCurves:
    """A run's forecaster: from states seen ``[W, context, S]`` to a curve's coefficients ``[W, K, P]``.

    Args:
        config: of the run, resolved.
        material: of its humanoid, with the states a regressor sees.
        run: the run directory.

    Attributes:
        context: frames it sees.

    Raises:
        InputError: what is kept in the run is damaged or not there.
    """

    def __init__(self, config: Mapping[str, Any], material: Material, run: Path) -> None:
        settings, _ = _settings(config)
        self.context, self._size = settings.context, _size(material)
        self._members = _members(settings, run / FOLDER, self._size, _fps(material))

    def __call__(self, pasts: Tensor) -> Tensor:
        return _curves(self._members, self._members[0].normalise(pasts[..., : self._size]))


def _settings(config: Mapping[str, Any]) -> tuple[ForecasterSettings, FitSettings]:
    values = {key: value for key, value in config["forecaster"].items() if key != "optimiser"}
    return ForecasterSettings.from_config(values), FitSettings.from_config(config["forecaster"]["optimiser"])


def _size(material: Material) -> int:
    """P: numbers of a humanoid state that are its pose and not its joints' velocities."""
    assert material.states is not None
    return 11 + (material.states.shape[1] - 11) // 2


def _fps(material: Material) -> float:
    return 1.0 / material.humanoid.control_dt


def _futures(material: Material, settings: ForecasterSettings, coefficients: Tensor, starts: Tensor) -> Futures:
    frames = len(material.reference)
    return Futures(coefficients, starts, frames, settings.horizon, settings.spacing, _fps(material))


@torch.no_grad()
def _curves(members: Sequence[MotionForecaster], contexts: Tensor) -> Tensor:
    """Mean curve of the members ``[W, K, P]`` in the pose's own units, from contexts ``[W, C, P]`` in deviations."""
    mean, std = members[0].mean, members[0].std
    parts = [torch.stack([member(part) for member in members]).mean(0) for part in contexts.split(512)]
    return torch.cat(parts) * std + mean


def _train(config: Mapping[str, Any], material: Material, folder: Path) -> None:
    """Fit all networks; write ``folder`` whole or not at all."""
    if material.states is None:
        raise InputError("configuration", "forecaster", "needs a trained state regressor")
    settings, optimiser = _settings(config)
    store = TakeStore.open(store_folder(config))
    pieces = split_takes(store.takes, config["data"]["split"], "train", supported_only=False)
    spans = [Span(*span) for span in global_spans(store, pieces)]
    truth, seen = humanoid_state(material.reference).float(), material.states
    size = _size(material)
    truth, seen = truth[:, :size], seen[:, :size]
    hands, seed, fps = [int(d) for d in material.humanoid.hand_dofs], int(config["seed"]), _fps(material)

    def members(fragments: Sequence[Span], label: str) -> list[MotionForecaster]:
        out: list[MotionForecaster] = []
        for number in range(settings.members):
            share = optimiser.validation_share
            draw = seed * 1000 + number
            learner = ForecastLearner(seen, truth, fragments, hands, settings, fps, optimiser.batch, share, draw)
            result = fit(learner, optimiser, draw, settings.total_frames)
            print(
                f"forecaster{label} {number}: held out E_pose {result.held_out:.3f} after {result.frames} frames",
                file=sys.stderr,
                flush=True,
            )
            out.append(learner.model)
        return out

    blocks = cross_fit_blocks(spans, settings.cross_fit)
    if config["data"]["split"]["kind"] == "subject":
        blocks = group_blocks(spans, [store.takes[piece.take].subject for piece in pieces], settings.cross_fit)
    whole = members(spans, "")
    coefficients, starts = [], []
    for fold, (others, now) in enumerate(cross_fit_starts(spans, blocks, settings)):
        if len(now):
            fitted = members(others, f" without block {fold}")
            rows = seen[now[:, None] + torch.arange(1 - settings.context, 1)]
            coefficients.append(_curves(fitted, fitted[0].normalise(rows)))
            starts.append(now)
    table = {"coefficients": torch.cat(coefficients), "starts": torch.cat(starts)}
    network = nn.ModuleList(whole)
    part = folder.with_name(f"{FOLDER}.part")
    shutil.rmtree(part, ignore_errors=True)
    made = {"members": network, "futures": ComponentState(lambda: table, lambda _: None)}
    RunCheckpoint(made).save(part, metadata=metadata_of("motion forecaster", size, 0, 0, 0.0))
    os.replace(part, folder)


def _members(settings: ForecasterSettings, folder: Path, size: int, fps: float) -> list[MotionForecaster]:
    zero, one = torch.zeros(size), torch.ones(size)
    members = [build_forecaster(settings, zero, one, fps, 0) for _ in range(settings.members)]
    network = nn.ModuleList(members)
    RunCheckpoint({"members": network}).restore(folder, {"members"})
    network.eval()
    return members
