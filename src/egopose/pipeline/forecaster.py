"""From a configuration to the kinematic forecasts a policy follows: trained once a run, kept in ``RUN_DIR/forecaster``.

Forecasts on training frames are cross-fitted, so the policy does not learn to over-trust them.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from egopose.checkpoint.checkpoint import ComponentState, RunCheckpoint, has_component, metadata_of
from egopose.checkpoint.run_folder import FOLDER
from egopose.core.errors import InputError
from egopose.data.preparation import flow_name, global_spans, store_folder
from egopose.data.spans import Span, cross_fit_blocks, group_blocks
from egopose.data.splits import split_takes
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.reference_forecasts import ReferenceForecasts
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.models.grounded_poses import grounded
from egopose.models.mirror import state_mirror
from egopose.models.motion_forecast import ContinuedForecaster, KernelForecaster, MotionForecaster, spline_basis
from egopose.pipeline.regressor import training_contexts
from egopose.tasks.dataset import Dataset
from egopose.training.continued_forecast import (
    blank_continued_forecaster,
    continued_share,
    fit_continued_forecaster,
)
from egopose.training.fitting import FitSettings, fit
from egopose.training.forecaster_settings import ForecasterSettings
from egopose.training.kernel_forecast import Contexts, blank_kernel_forecaster, fit_kernel_forecaster
from egopose.training.motion_forecast import ForecastLearner, build_forecaster, cross_fit_starts


@dataclass(frozen=True)
class Members:
    """The parts of a forecaster: ``(1 - share) * mean of the networks' curves + share * the kernel's``. Each
    coefficient is then mixed, by a share ``[K, 1]``, with that of the network that goes on frame by frame."""

    networks: list[MotionForecaster]
    kernel: KernelForecaster | None = None
    share: float = 0.0
    continued: ContinuedForecaster | None = None
    continued_share: Tensor | None = None


def with_forecasts(config: Mapping[str, Any], dataset: Dataset, run: Path) -> Dataset:
    """The dataset with the run's forecasts. The forecaster is trained if the run does not have one yet.

    The dataset itself if the run has no forecaster, or if it has forecasts already.

    Args:
        config: resolved; its group ``forecaster`` says how, or is null.
        dataset: with the states a regressor sees.
        run: the run directory.

    Raises:
        InputError: a setting is wrong, there are no regressed states, or what is kept is damaged.
    """
    if config.get("forecaster") is None or dataset.forecasts is not None:
        return dataset
    settings, _ = _settings(config)
    folder = run / FOLDER
    if not folder.is_dir():
        _train(config, dataset, folder)
    saved: dict[str, Tensor] = {}
    if has_component(folder, "futures"):
        RunCheckpoint({"futures": ComponentState(dict, saved.update)}).restore(folder, {"futures"})
    else:  # shipped without those of its training frames: others are put in where a forecast begins
        assert dataset.states is not None
        knots, size = spline_basis(settings.horizon + 1, settings.spacing, _fps(dataset))[0].shape[1], _size(dataset)
        saved = {"coefficients": torch.zeros(0, knots, size), "starts": torch.zeros(0, dtype=torch.int64)}
    return replace(dataset, forecasts=_futures(dataset, settings, saved["coefficients"], saved["starts"]))


def still_forecasts(config: Mapping[str, Any], dataset: Dataset) -> Dataset:
    """The dataset with forecasts of a body that stays as it is in the first frame."""
    assert dataset.states is not None
    settings, _ = _settings(config)
    knots = spline_basis(settings.horizon + 1, settings.spacing, _fps(dataset))[0].shape[1]
    # The splines add up to one everywhere.
    frames = len(dataset.reference)
    curves = dataset.states[:1, None, : _size(dataset)].expand(frames, knots, -1)
    return replace(dataset, forecasts=_futures(dataset, settings, curves, torch.arange(frames)))


class ForecastCurves:
    """A run's forecaster: from states seen ``[W, context, S]`` to a curve's coefficients ``[W, K, P]``.

    Args:
        config: of the run, resolved.
        dataset: of its humanoid, with the states a regressor sees.
        run: the run directory.

    Attributes:
        context: frames it sees.

    Raises:
        InputError: what is kept in the run is damaged or not there.
    """

    def __init__(self, config: Mapping[str, Any], dataset: Dataset, run: Path) -> None:
        settings, _ = _settings(config)
        self.context, self._size = settings.context, _size(dataset)
        self._members = _members(settings, run / FOLDER, self._size, _fps(dataset))
        self._settings, self._humanoid = settings, dataset.humanoid

    def __call__(self, pasts: Tensor) -> Tensor:
        return _curves(self._members, pasts[..., : self._size].float(), self._settings, self._humanoid)


def _settings(config: Mapping[str, Any]) -> tuple[ForecasterSettings, FitSettings]:
    values = {key: value for key, value in config["forecaster"].items() if key != "optimiser"}
    return ForecasterSettings.from_config(values), FitSettings.from_config(config["forecaster"]["optimiser"])


def _size(dataset: Dataset) -> int:
    """P: numbers of a humanoid state that are its pose and not its joints' velocities."""
    assert dataset.states is not None
    return StateLayout.of_size(dataset.states.shape[1]).pose_size


def _fps(dataset: Dataset) -> float:
    return 1.0 / dataset.humanoid.control_dt


def _futures(
    dataset: Dataset, settings: ForecasterSettings, coefficients: Tensor, starts: Tensor
) -> ReferenceForecasts:
    frames = len(dataset.reference)
    return ReferenceForecasts(coefficients, starts, frames, settings.horizon, settings.spacing, _fps(dataset))


@torch.no_grad()
def _curves(members: Members, contexts: Tensor, settings: ForecasterSettings, humanoid: HumanoidModel) -> Tensor:
    """Curve of the members ``[W, K, P]`` from contexts ``[W, C, P]``, in the pose's own units, grounded if asked."""
    curves = [_curve(members, part) for part in contexts.split(512)]
    if settings.mass_ahead is not None:
        basis = spline_basis(settings.horizon + 1, settings.spacing, 1.0 / humanoid.control_dt)[0]
        fit = torch.linalg.pinv(basis.double())
        for number, curve in enumerate(curves):
            poses = grounded((basis @ curve).double().numpy(), humanoid, settings.mass_ahead)
            curves[number] = fit.matmul(torch.from_numpy(poses)).float()
    return torch.cat(curves)


def _curve(members: Members, contexts: Tensor) -> Tensor:
    def of(member: MotionForecaster | KernelForecaster | ContinuedForecaster) -> Tensor:
        return member((contexts - member.mean) / member.std) * member.std + member.mean

    curve = torch.stack([of(network) for network in members.networks]).mean(0)
    if members.kernel is not None:
        curve = torch.lerp(curve, of(members.kernel), members.share)
    if members.continued is None or members.continued_share is None:
        return curve
    return torch.lerp(curve, of(members.continued), members.continued_share)


def _train(config: Mapping[str, Any], dataset: Dataset, folder: Path) -> None:
    """Fit all networks; write ``folder`` whole or not at all."""
    if dataset.states is None:
        raise InputError("configuration", "forecaster", "needs a trained state regressor")
    settings, optimiser = _settings(config)
    if settings.cross_fit < 2 and config["training"]["total_steps"] != 0:
        cause = (
            "1 is for training.total_steps=0: a policy would learn to trust forecasts by networks that know the future"
        )
        raise InputError("conf/forecaster", "cross_fit", cause)
    store = TakeStore.open(store_folder(config))
    pieces = split_takes(store.takes, config["data"]["split"], "train", supported_only=False)
    spans = [Span(*span) for span in global_spans(store, pieces)]
    size = _size(dataset)
    truth = humanoid_state(dataset.reference).float()[:, :size]
    # No shorter than the least context: a stretch without one has nothing to say.
    ends = [torch.arange(s.start + settings.context - 1, s.stop) for s in spans]
    starts = torch.cat([torch.zeros(0, dtype=torch.int64), *ends])
    rows = training_contexts(config, store, dataset.humanoid, flow_name(config), starts, settings.context)[..., :size]
    seen = Contexts.at(rows, starts, len(truth))
    mirror = state_mirror(dataset.humanoid.skeleton).poses()
    hands, seed, fps = [int(d) for d in dataset.humanoid.hand_dofs], int(config["seed"]), _fps(dataset)

    def members(fragments: Sequence[Span], label: str) -> Members:
        out: list[MotionForecaster] = []
        for number in range(settings.members):
            share = optimiser.validation_share
            draw = seed * 1000 + number
            learner = ForecastLearner(
                seen, truth, fragments, mirror, hands, settings, fps, optimiser.batch, share, draw
            )
            result = fit(learner, optimiser, draw, settings.total_frames)
            print(
                f"forecaster{label} {number}: held out E_pose {result.held_out:.3f} after {result.frames} frames",
                file=sys.stderr,
                flush=True,
            )
            out.append(learner.model)
        made = Members(out)
        if settings.kernel is not None:
            kernel = fit_kernel_forecaster(seen, truth, fragments, mirror, settings, fps)
            made = replace(made, kernel=kernel, share=settings.kernel.share)
        if settings.continued is not None:
            continued, result = fit_continued_forecaster(truth, fragments, mirror, settings, fps, seed)
            print(
                f"forecaster{label}, frame by frame: held out {result.held_out:.3f} after {result.frames} frames",
                file=sys.stderr,
                flush=True,
            )
            made = replace(made, continued=continued, continued_share=continued_share(settings))
        return made

    whole = members(spans, "")
    if settings.cross_fit < 2:
        coefficients, begun = [_curves(whole, seen[starts], settings, dataset.humanoid)], [starts]
    else:
        blocks = cross_fit_blocks(spans, settings.cross_fit)
        if config["data"]["split"]["kind"] == "subject":
            blocks = group_blocks(spans, [store.takes[piece.take].subject for piece in pieces], settings.cross_fit)
        coefficients, begun = [], []
        for fold, (others, now) in enumerate(cross_fit_starts(spans, blocks, settings)):
            if len(now):
                fitted = members(others, f" without block {fold}")
                coefficients.append(_curves(fitted, seen[now], settings, dataset.humanoid))
                begun.append(now)
    table = {"coefficients": torch.cat(coefficients), "starts": torch.cat(begun)}
    part = folder.with_name(f"{FOLDER}.part")
    shutil.rmtree(part, ignore_errors=True)
    made: dict[str, Any] = {"members": nn.ModuleList(whole.networks)}
    made["futures"] = ComponentState(lambda: table, lambda _: None)
    if whole.kernel is not None:
        sizes = {"centres": torch.tensor(len(whole.kernel.kernel.centres))}
        made["kernel"], made["sizes"] = whole.kernel, ComponentState(lambda: sizes, lambda _: None)
    if whole.continued is not None:
        made["continued"] = whole.continued
    RunCheckpoint(made).save(part, metadata=metadata_of("motion forecaster", size, 0, 0, 0.0))
    os.replace(part, folder)


def _members(settings: ForecasterSettings, folder: Path, size: int, fps: float) -> Members:
    zero, one = torch.zeros(size), torch.ones(size)
    networks = [build_forecaster(settings, zero, one, fps, 0) for _ in range(settings.members)]
    parts: dict[str, Any] = {"members": nn.ModuleList(networks)}
    kernel, continued = None, None
    if settings.kernel is not None:
        sizes: dict[str, Tensor] = {}
        RunCheckpoint({"sizes": ComponentState(dict, sizes.update)}).restore(folder, {"sizes"})
        kernel = parts["kernel"] = blank_kernel_forecaster(settings, zero, one, fps, int(sizes["centres"]))
    if settings.continued is not None:
        continued = parts["continued"] = blank_continued_forecaster(settings, zero, one, fps)
    RunCheckpoint(parts).restore(folder, set(parts))
    for part in parts.values():
        part.eval()
    return Members(
        networks,
        kernel,
        0.0 if settings.kernel is None else settings.kernel.share,
        continued,
        None if settings.continued is None else continued_share(settings),
    )
