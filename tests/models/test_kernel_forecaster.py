"""The kernel forecaster: by formula, by symmetry, beside the networks, and blind to what it is to forecast."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.blended_regressor import KERNEL, blended
from helpers.continued_forecaster import continued
from helpers.env_stand_in import group
from helpers.forecast_curves import FPS, SMALL, contexts_of, settings, unmirrored, wave
from helpers.humanoid_stand_in import stand_in
from helpers.small_store import configuration, fill_flow
from torch import Tensor, nn

from egopose.checkpoint.checkpoint import ComponentState, RunCheckpoint, has_component, metadata_of
from egopose.checkpoint.package import _copy_components
from egopose.checkpoint.run_folder import FOLDER, PARTS
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.torch_settings import torch_threads
from egopose.data.preparation import flow_name, humanoid_of, prepare
from egopose.data.spans import Span, cross_fit_blocks
from egopose.data.splits import split_takes
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.context_states import context_states
from egopose.models.kernel_regression import fit_kernel_regression
from egopose.models.mirror import StateMirror, state_mirror
from egopose.models.motion_forecast import KernelForecaster, spline_basis, spline_times
from egopose.models.predictions import predict_takes
from egopose.pipeline import forecaster as motion_forecasts
from egopose.pipeline import regressor as regression
from egopose.pipeline.forecaster import ForecastCurves, Members, with_forecasts
from egopose.pipeline.regressor import load_regressor, regressor_name, regressor_tables, training_contexts
from egopose.tasks.dataset import Dataset, take_table
from egopose.training import blended_regressor as blending
from egopose.training import past_contexts as past
from egopose.training.blended_regressor import KernelSettings
from egopose.training.continued_forecast import continued_share
from egopose.training.fitting import fit
from egopose.training.kernel_forecast import Contexts, blank_kernel_forecaster, fit_kernel_forecaster
from egopose.training.motion_forecast import ForecastLearner, build_forecaster, cross_fit_starts
from egopose.training.past_contexts import past_contexts

HERE: dict[str, Any] = {
    "bins": [2, 3], "axes": 1000, "whitening": 0.5, "ridge": 0.1, "length": 1.0, "centres": 1000, "share": 0.3,
    "added": 1.0, "least": 12, "kept_ridge": 1e-3,
}  # fmt: skip
CONTEXT, HORIZON = SMALL["context"], SMALL["horizon"]


@pytest.fixture(autouse=True)
def _one_thread_and_seed() -> Iterator[None]:
    torch.manual_seed(0)
    with torch_threads(1):
        yield


def with_kernel(**changes: Any) -> Any:
    return settings(kernel={**HERE, **changes})


def fitted(poses: Tensor, fragments: list[Span], mirror: StateMirror, **changes: Any) -> KernelForecaster:
    return fit_kernel_forecaster(contexts_of(poses, CONTEXT), poses, fragments, mirror, with_kernel(**changes), FPS)


@torch.no_grad()
def forecasts(model: KernelForecaster, contexts: Tensor) -> Tensor:
    """Poses ``[B, horizon + 1, P]`` in their own units."""
    basis = spline_basis(HORIZON + 1, SMALL["spacing"], FPS)[0]
    return basis @ model((contexts - model.mean) / model.std) * model.std + model.mean


# --- contexts --------------------------------------------------------------------------------------------------------


def test_contexts_are_looked_up_by_their_last_frame() -> None:
    rows, starts = torch.randn(4, 3, 2), torch.tensor([9, 2, 5, 7])
    made = Contexts.at(rows, starts, 11)
    assert made.row.tolist() == [-1, -1, 1, -1, -1, 2, -1, 3, -1, 0, -1]
    assert torch.equal(made[torch.tensor([5, 9, 5])], rows[[2, 0, 2]])
    assert torch.equal(made[starts], rows)


# --- the fit ---------------------------------------------------------------------------------------------------------


def decaying(rates: Tensor, spans: int, frames: int) -> tuple[Tensor, list[Span]]:
    """Poses that shrink to nought, from starts of chance and from their opposites: mean nought."""
    start = torch.randn(spans, 1, len(rates))
    poses = torch.cat([start, -start]) * rates ** torch.arange(frames)[:, None]
    return poses.flatten(0, 1), [Span(k * frames, (k + 1) * frames) for k in range(2 * spans)]


def test_of_a_future_linear_in_the_last_pose_the_shares_alone_know_it_all() -> None:
    rates = torch.linspace(0.9, 0.99, 15)
    poses, spans = decaying(rates, 6, 30)
    model = fitted(poses, spans, unmirrored(poses), least=HORIZON, kept_ridge=1e-6)
    assert model.kernel(model.parts(contexts_of(poses, CONTEXT).rows)).abs().max() < 0.01
    model.kernel.coefficients.zero_()
    model.kernel.output_mean.zero_()
    last = torch.randn(4, 1, 15)
    seen = last * rates ** torch.arange(1 - CONTEXT, 1)[:, None]
    wanted = last * rates ** torch.arange(HORIZON + 1)[:, None]
    torch.testing.assert_close(forecasts(model, seen), wanted, atol=5e-3, rtol=0)


def test_a_swing_is_forecast_far_better_than_by_standing_still_and_by_the_mean() -> None:
    poses = wave(200)
    model = fitted(poses, [Span(0, 100)], unmirrored(poses))
    now = torch.arange(120, 180)
    seen = contexts_of(poses, CONTEXT)[now]
    truth = poses[now[:, None] + torch.arange(HORIZON + 1)]

    def pose_error(told: Tensor) -> float:
        return float((told - truth)[..., 5:9].norm(dim=-1).mean())

    told, still, mean = forecasts(model, seen), seen[:, -1:], poses[:100].mean(0)
    assert pose_error(told) < 0.15 * min(pose_error(still), pose_error(mean))


def test_its_shares_and_its_kernel_are_ridge_regressions_of_the_splines_coefficients() -> None:
    """A take's last pose stands for what comes after it; the moments are those with a context and the least behind."""
    poses = torch.randn(40, 13).cumsum(0)
    mirror = StateMirror(torch.arange(13).flip(0), torch.tensor([1.0] * 6 + [-1.0] + [1.0] * 6))
    spans, least, kept_ridge = [Span(3, 20), Span(21, 26), Span(26, 40)], 3, 0.05
    chosen: dict[str, Any] = {"axes": 9, "whitening": 0.5, "ridge": 0.2, "length": 1.5}
    noisy = poses + 0.1 * torch.randn(40, 13)
    contexts = contexts_of(noisy, CONTEXT)
    made = with_kernel(**chosen, least=least, kept_ridge=kept_ridge, added=0.4)
    model = fit_kernel_forecaster(contexts, poses, spans, mirror, made, FPS)

    moments = [(now, s.stop) for s in (spans[0], spans[2]) for now in range(s.start + CONTEXT - 1, s.stop - least)]
    learned = torch.cat([poses[3:20], poses[26:40]]).double().numpy()
    learned = np.concatenate([learned, learned[:, ::-1] * mirror.sign.numpy()])
    mean, std = learned.mean(0), learned.std(0)
    np.testing.assert_allclose(model.mean, mean, atol=1e-5)
    np.testing.assert_allclose(model.std, std, rtol=1e-5)
    seen = np.stack([noisy[now - CONTEXT + 1 : now + 1].double().numpy() for now, _ in moments])
    to_come = [[min(now + k, stop - 1) for k in range(HORIZON + 1)] for now, stop in moments]
    future = poses.double().numpy()[to_come]
    seen, future = (
        (np.concatenate([rows, rows[..., ::-1] * mirror.sign.numpy()]) - mean) / std for rows in (seen, future)
    )
    basis = spline_basis(HORIZON + 1, SMALL["spacing"], FPS)[0].double().numpy()
    wanted = np.linalg.pinv(basis) @ future
    rest = wanted.copy()
    for p in range(13):
        pair = np.stack([seen[:, -1, p], seen[:, :, p].mean(1)], axis=1)
        square = pair.T @ pair / len(pair)
        square += np.diag(kept_ridge * np.diag(square) + 1e-6)
        shares = np.linalg.solve(square, pair.T @ wanted[:, :, p] / len(pair))
        np.testing.assert_allclose(model.kept[:, :, p], shares, atol=1e-3)
        rest[:, :, p] -= pair @ shares
    parts = np.concatenate([seen[:, 3:].mean(1), seen[:, :3].mean(1)], axis=-1)
    inputs, outputs = (torch.from_numpy(rows).flatten(1).float() for rows in (parts, 0.4 * rest))
    by_hand = fit_kernel_regression(inputs, outputs, **chosen)
    fresh = torch.randn(5, 26)
    torch.testing.assert_close(model.kernel(fresh), by_hand(fresh), atol=2e-3, rtol=0)
    assert not model.training

    context = torch.randn(2, CONTEXT, 13)
    by_kernel = by_hand(torch.cat([context[:, 3:].mean(1), context[:, :3].mean(1)], dim=-1)).unflatten(-1, (-1, 13))
    expected = model.kept[0] * context[:, -1:] + model.kept[1] * context.mean(1, keepdim=True) + by_kernel
    torch.testing.assert_close(model(context), expected, atol=2e-3, rtol=0)


def paired(size: int) -> StateMirror:
    """Numbers that change places with a neighbour, some of them turned round, and two that stay."""
    index = torch.arange(size)
    index[: size - 2] = index[: size - 2].reshape(-1, 2).flip(1).flatten()
    sign = torch.ones(size)
    sign[2:4], sign[-1] = -1.0, -1.0
    return StateMirror(index, sign)


@pytest.mark.parametrize("body", ["paired", "stand_in"])
def test_of_a_mirrored_context_it_forecasts_the_mirrored_motion(body: str) -> None:
    """Every moment is a centre; each number has the statistics of its image, as units of its own would tell them
    apart."""
    mirror = paired(14) if body == "paired" else state_mirror(stand_in().skeleton).poses()
    poses = torch.randn(60, len(mirror.index)).cumsum(0)
    poses = (poses - poses.mean(0)) / poses.std(0, correction=0)
    model = fitted(poses, [Span(0, 60)], mirror, ridge=0.3)
    assert len(model.kernel.centres) == 2 * (60 - CONTEXT - HORIZON + 1)
    fresh = torch.randn(20, CONTEXT, poses.shape[1]).cumsum(1)
    told = forecasts(model, fresh)
    torch.testing.assert_close(forecasts(model, mirror.state(fresh)), mirror.state(told), atol=2e-3, rtol=0)
    assert (told - mirror.state(told)).abs().mean() > 0.2
    plain = fitted(poses, [Span(0, 60)], unmirrored(poses), ridge=0.3)
    assert (forecasts(plain, mirror.state(fresh)) - mirror.state(forecasts(plain, fresh))).abs().max() > 0.2


def test_the_mirror_of_poses_is_the_one_of_states_without_the_joints_velocities() -> None:
    whole = state_mirror(stand_in().skeleton)
    poses, size = whole.poses(), StateLayout.of_size(len(whole.index)).pose_size
    states = torch.randn(3, len(whole.index))
    assert torch.equal(poses.state(states[:, :size]), whole.state(states)[:, :size])


@pytest.mark.parametrize(("centres", "kept"), [(1000, 168), (41, 40), (4, 4)])
def test_half_of_the_centres_are_images(centres: int, kept: int) -> None:
    poses = wave(100) + 0.1 * torch.randn(100, 15)
    negated = StateMirror(torch.arange(15), -torch.ones(15))
    model = fitted(poses, [Span(0, 100)], negated, centres=centres)
    now = torch.linspace(CONTEXT - 1, 99 - HORIZON, kept // 2).round().long()
    seen = contexts_of(poses, CONTEXT)[now]
    inputs = model.parts((torch.cat([seen, -seen]) - model.mean) / model.std)
    assert len(model.kernel.centres) == kept
    torch.testing.assert_close(model.kernel.centres, model.kernel.project(inputs), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("bins", [[5], [2, 3], [1, 1, 3], [3, 1, 1]])
def test_the_parts_are_the_means_of_the_bins_the_latest_first(bins: list[int]) -> None:
    blank = blank_kernel_forecaster(with_kernel(bins=bins), torch.zeros(13), torch.ones(13), FPS, 2)
    context = torch.randn(4, CONTEXT, 13)
    ends = CONTEXT - np.cumsum([0, *bins])
    expected = [context[:, b:a].numpy().mean(1) for a, b in itertools.pairwise(ends)]
    np.testing.assert_allclose(blank.parts(context), np.concatenate(expected, axis=1), atol=1e-6)


@pytest.mark.parametrize(("longest", "learns"), [(CONTEXT + 11, False), (CONTEXT + 12, True)])
def test_too_short_a_stretch_is_named(longest: int, learns: bool) -> None:
    poses = wave(60)
    spans = [Span(0, 6), Span(20, 20 + longest)]
    if learns:
        assert len(fitted(poses, spans, unmirrored(poses), least=12).kernel.centres) == 2
        return
    with pytest.raises(InputError, match=r"fragments.*5 \+ 12"):
        fitted(poses, spans, unmirrored(poses), least=12)


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("bins", [2, 2], "bins.*5 frames, not 4"),
        ("bins", [], "bins"),
        ("bins", [5, 0], "bins"),
        ("least", 0, "least"),
        ("axes", 0, "axes"),
        ("ridge", 0.0, "ridge"),
        ("kept_ridge", 0.0, "ridge"),
        ("length", -1.0, "ridge"),
        ("centres", 3, "centres"),
        ("share", 1.0, "share"),
        ("share", 0.0, "share"),
        ("added", 0.0, "added"),
        ("added", 1.1, "added"),
        ("shares", 0.5, "shares"),
    ],
)
def test_settings_that_make_no_kernel_are_named(key: str, value: Any, named: str) -> None:
    with pytest.raises(InputError, match=named):
        with_kernel(**{key: value})


# --- windows and their images ----------------------------------------------------------------------------------------


def test_half_of_the_windows_are_images_and_so_are_their_futures() -> None:
    """Bodies that stand still: a forecaster that keeps the last pose errs in no window, mirrored or not."""
    poses = (1.0 + torch.rand(6, 1, 15)).expand(6, 30, 15).flatten(0, 1).clone()
    poses[:, -3:] += 0.2
    spans = [Span(30 * k, 30 * k + 30) for k in range(6)]
    negated = StateMirror(torch.arange(15).flip(0), -torch.ones(15))
    made, seen = settings(input_noise=0.0, dropout=0.0), contexts_of(poses, CONTEXT)
    learner = ForecastLearner(seen, poses, spans, negated, [1], made, FPS, 16, 0.2, seed=0)
    learner.model.kept.data[0], learner.model.kept.data[1] = 1.0, 0.0
    given: list[Tensor] = []
    learner.model.register_forward_pre_hook(lambda model, args: given.append(args[0] * model.std + model.mean))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        losses = [float(learner.loss(generator, 0.0)[0]) for _ in range(50)]
    assert max(losses) < 2e-3
    learned = torch.cat(given)
    images = (learned < 0).all(dim=(1, 2))
    assert (images | (learned > 0).all(dim=(1, 2))).all()
    assert 0.45 < images.float().mean() < 0.55
    own = {tuple(row.round(decimals=4).tolist()) for row in poses[::30]}
    assert {tuple(row.round(decimals=4).tolist()) for row in negated.state(learned[images, 0])} <= own
    given.clear()
    assert learner.held_out() < 2e-3
    assert (torch.cat(given) > 0).all(), "what is held out is judged as it is"


# --- beside the networks ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("forecaster")
    prepare(configuration(folder), progress=False, flow=False)
    fill_flow(configuration(folder))
    return folder


def stored(folder: Path) -> dict[str, Any]:
    """Frames enough for contexts with others beside them, and a forecaster with a kernel."""
    config = blended(folder)
    config["data"] = {**config["data"], "split": {**config["data"]["split"], "train_share": 0.95}}
    config["regressor"] |= {"epochs": 1, "kernel": {**KERNEL, "also": [[0, 1, 0.5]], "mirror": True, "axes": 20}}
    fast = group("forecaster", "fast")
    optimiser = {**fast["optimiser"], "batch": 4, "validation_share": 0.3}
    config["forecaster"] = {
        **fast, **SMALL, "horizon": 6, "cross_fit": 2, "total_frames": 400, "optimiser": optimiser,
        "kernel": {**HERE, "least": 2, "axes": 8},
    }  # fmt: skip
    return config


def dataset_of(config: dict[str, Any], store: TakeStore) -> Dataset:
    pieces = split_takes(store.takes, config["data"]["split"], "train", supported_only=False)
    states = humanoid_state(store.reference).float()
    return Dataset(humanoid_of(config), store.reference, take_table(store.takes), pieces, pieces, states=states)


@torch.no_grad()
def mixed(networks: list[nn.Module], kernel: KernelForecaster, share: float, contexts: Tensor) -> Tensor:
    def own_units(model: Any) -> Tensor:
        return model((contexts - model.mean) / model.std) * model.std + model.mean

    mean = sum(own_units(network) for network in networks) / len(networks)
    return (1 - share) * mean + share * own_units(kernel)


def test_a_run_learns_keeps_and_reads_back_networks_and_kernel(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, store = stored(folder), TakeStore.open(folder / "store")
    dataset = dataset_of(config, store)
    assert dataset.states is not None
    networks: list[Any] = []
    kernels: list[KernelForecaster] = []
    asked: list[Any] = []
    fit_network, fit_kernel = fit, fit_kernel_forecaster
    noisy = dataset.states + 0.1 * torch.randn(dataset.states.shape)

    def contexts(_: Any, __: Any, ___: Any, name: str, starts: Tensor, context: int) -> Tensor:
        assert (name, context) == (flow_name(config), CONTEXT)
        return noisy[starts[:, None] + torch.arange(1 - context, 1)]

    def learned(learner: Any, *rest: Any) -> Any:
        networks.append(learner.model)
        return fit_network(learner, *rest)

    def learned_kernel(*given: Any) -> KernelForecaster:
        asked.append(given)
        kernels.append(fit_kernel(*given))
        return kernels[-1]

    for name, stand in (("training_contexts", contexts), ("fit", learned), ("fit_kernel_forecaster", learned_kernel)):
        monkeypatch.setattr(motion_forecasts, name, stand)
    run = tmp_path / "run"
    followed = with_forecasts(config, dataset, run)
    assert (len(networks), len(kernels)) == (6, 3)
    whole = [Span(0, 38), Span(38, 77)]
    made = motion_forecasts._settings(config)[0]
    parts = cross_fit_starts(whole, cross_fit_blocks(whole, 2), made)
    assert [given[2] for given in asked] == [whole, *(others for others, _ in parts)]
    size = StateLayout(dataset.humanoid.mj_model.nu).pose_size
    assert torch.equal(asked[0][0].rows[0], noisy[:5, :size])

    futures = followed.forecasts
    assert futures is not None
    for number, (_, starts) in enumerate(parts, start=1):
        now = starts[:, None] + torch.arange(1 - CONTEXT, 1)
        expected = mixed(networks[2 * number : 2 * number + 2], kernels[number], 0.3, noisy[now, :size])
        torch.testing.assert_close(futures.coefficients[torch.isin(futures.starts, starts)], expected)
    assert futures.starts.tolist() == [*range(4, 19), *range(42, 57), *range(19, 38), *range(57, 77)]

    # Read back it is exactly what was learned: what the networks hold out to judge themselves by the kernel learns.
    assert not torch.equal(networks[0].mean, kernels[0].mean)
    pasts = torch.randn(3, CONTEXT, dataset.states.shape[1]).cumsum(1)
    told = ForecastCurves(config, dataset, run)(pasts)
    kept = motion_forecasts._members(made, run / FOLDER, size, FPS)
    assert kept.share == 0.3
    for one, other in zip([*networks[:2], kernels[0]], [*kept.networks, kept.kernel], strict=True):
        assert one.state_dict().keys() == other.state_dict().keys()
        assert all(torch.equal(value, other.state_dict()[key]) for key, value in one.state_dict().items())
    torch.testing.assert_close(told, mixed(networks[:2], kernels[0], 0.3, pasts[..., :size]), atol=1e-5, rtol=1e-5)
    assert (told - mixed(networks[:2], kernels[0], 0.0, pasts[..., :size])).abs().max() > 0.05
    for name in ("fit", "fit_kernel_forecaster"):
        monkeypatch.setattr(motion_forecasts, name, lambda *_: pytest.fail("learned twice"))
    again = with_forecasts(config, dataset, run).forecasts
    assert again is not None
    assert torch.equal(again.coefficients, futures.coefficients)

    shipped = tmp_path / "shipped"
    there = [name for name in PARTS if has_component(run / FOLDER, name)]
    assert there == ["members", "kernel", "sizes"]
    _copy_components(run / FOLDER, shipped / FOLDER, there)
    assert not has_component(shipped / FOLDER, "forecasts")
    assert torch.equal(ForecastCurves(config, dataset, shipped)(pasts), told)
    afresh = with_forecasts(config, dataset, shipped).forecasts
    assert afresh is not None
    assert len(afresh.starts) == 0
    assert (afresh.coefficients.shape[1:], afresh.horizon) == (futures.coefficients.shape[1:], 6)


def test_a_run_with_one_that_goes_on_frame_by_frame_learns_keeps_ships_and_reads_it_back(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, store = stored(folder), TakeStore.open(folder / "store")
    config["forecaster"]["members"] = 1
    config["forecaster"]["continued"] = continued(share=0.4, until=5)
    dataset = dataset_of(config, store)
    assert dataset.states is not None
    size = StateLayout(dataset.humanoid.mj_model.nu).pose_size
    noisy = dataset.states + 0.1 * torch.randn(dataset.states.shape)
    monkeypatch.setattr(
        motion_forecasts, "training_contexts",
        lambda _, __, ___, ____, starts, context: noisy[starts[:, None] + torch.arange(1 - context, 1)],
    )  # fmt: skip
    asked: list[Any] = []
    made_of: dict[str, list[Any]] = {name: [] for name in ("fit", "fit_kernel_forecaster", "fit_continued_forecaster")}

    def spied(name: str) -> Any:
        fitted = getattr(motion_forecasts, name)

        def learned(*given: Any) -> Any:
            out = fitted(*given)
            if name == "fit_continued_forecaster":
                asked.append(given)
            result = out[0] if isinstance(out, tuple) else out
            made_of[name].append(given[0].model if name == "fit" else result)
            return out

        return learned

    for name in made_of:
        monkeypatch.setattr(motion_forecasts, name, spied(name))
    run = tmp_path / "run"
    futures = with_forecasts(config, dataset, run).forecasts
    assert futures is not None
    networks, kernels, others = made_of.values()
    assert (len(networks), len(kernels), len(others)) == (3, 3, 3)
    # What it learns from are true poses, of all training frames, or of those apart from the block it tells of.
    whole, made = [Span(0, 38), Span(38, 77)], motion_forecasts._settings(config)[0]
    parts = cross_fit_starts(whole, cross_fit_blocks(whole, 2), made)
    assert [given[1] for given in asked] == [whole, *(rest for rest, _ in parts)]
    for truth, _, mirror, given, fps, seed in asked:
        assert torch.equal(truth, dataset.states[:, :size])
        assert torch.equal(mirror.index, state_mirror(dataset.humanoid.skeleton).poses().index)
        assert (given, fps, seed) == (made, 1 / dataset.humanoid.control_dt, config["seed"])

    share = torch.tensor([max(0.0, 0.4 * (1 - float(t) / 5)) for t in spline_times(7, SMALL["spacing"])])[:, None]
    assert share[0] == 0.4
    assert share[-1] == 0

    @torch.no_grad()
    def by_hand(number: int, contexts: Tensor) -> Tensor:
        one = others[number]
        curve = one((contexts - one.mean) / one.std) * one.std + one.mean
        return (1 - share) * mixed(networks[number : number + 1], kernels[number], 0.3, contexts) + share * curve

    for number, (_, starts) in enumerate(parts, start=1):
        contexts = noisy[starts[:, None] + torch.arange(1 - CONTEXT, 1), :size]
        found = futures.coefficients[torch.isin(futures.starts, starts)]
        torch.testing.assert_close(found, by_hand(number, contexts), atol=1e-4, rtol=1e-4)

    # Read back, here or where it was shipped to, it is exactly what was learned.
    kept = motion_forecasts._members(made, run / FOLDER, size, FPS)
    for before, read in zip(
        (networks[0], kernels[0], others[0]), (kept.networks[0], kept.kernel, kept.continued), strict=True
    ):
        assert isinstance(read, nn.Module)
        assert before.state_dict().keys() == read.state_dict().keys()
        assert all(torch.equal(value, read.state_dict()[key]) for key, value in before.state_dict().items())
        assert not read.training
    own = [value for part in (kept.networks[0], kept.kernel, kept.continued) for value in (part.mean, part.std)]  # type: ignore[union-attr]
    assert len({value.data_ptr() for value in own}) == len(own), "each has statistics of its own"
    pasts = torch.randn(3, CONTEXT, dataset.states.shape[1]).cumsum(1)
    learned = Members(networks[:1], kernels[0], 0.3, others[0], continued_share(made))
    told = ForecastCurves(config, dataset, run)(pasts)
    seen = pasts[..., :size]
    assert kept.continued is not None
    with torch.no_grad():
        assert torch.equal(kept.continued(seen), others[0](seen))
    # The kernel's rows lie otherwise in memory: its last digits may differ.
    torch.testing.assert_close(
        told, motion_forecasts._curves(learned, seen, made, dataset.humanoid), atol=1e-5, rtol=1e-6
    )
    torch.testing.assert_close(told, by_hand(0, seen), atol=1e-4, rtol=1e-4)
    without = mixed(networks[:1], kernels[0], 0.3, seen)
    assert (told - without)[:, 0].abs().max() > 0.05
    torch.testing.assert_close(told[:, -1], without[:, -1], atol=1e-4, rtol=1e-4)
    there = [name for name in PARTS if has_component(run / FOLDER, name)]
    assert there == ["members", "kernel", "sizes", "continued"]
    _copy_components(run / FOLDER, tmp_path / "shipped" / FOLDER, there)
    assert torch.equal(ForecastCurves(config, dataset, tmp_path / "shipped")(pasts), told)
    for name in made_of:
        monkeypatch.setattr(motion_forecasts, name, lambda *_: pytest.fail("learned twice"))
    again = with_forecasts(config, dataset, run).forecasts
    assert again is not None
    assert torch.equal(again.coefficients, futures.coefficients)

    # A run's folder without it is no run of these settings.
    _copy_components(run / FOLDER, tmp_path / "less" / FOLDER, there[:-1])
    with pytest.raises(InputError, match="continued"):
        ForecastCurves(config, dataset, tmp_path / "less")
    # Settings without it, as of runs from before there was one, read what such a run kept.
    forecaster = config["forecaster"]
    for older in ({**forecaster, "continued": None}, {k: v for k, v in forecaster.items() if k != "continued"}):
        found = ForecastCurves({**config, "forecaster": older}, dataset, tmp_path / "less")(pasts)
        torch.testing.assert_close(found, without, atol=1e-5, rtol=1e-5)


def test_a_run_from_before_there_was_a_kernel_forecasts_by_its_networks_alone(folder: Path, tmp_path: Path) -> None:
    config, store = stored(folder), TakeStore.open(folder / "store")
    config["forecaster"] = {key: value for key, value in config["forecaster"].items() if key != "kernel"}
    dataset, made = dataset_of(config, store), motion_forecasts._settings(config)[0]
    assert made.kernel is None
    size = StateLayout(dataset.humanoid.mj_model.nu).pose_size
    networks = [build_forecaster(made, torch.randn(size), 1 + torch.rand(size), FPS, seed).eval() for seed in range(2)]
    table = {"coefficients": torch.zeros(1, 5, size), "starts": torch.tensor([7])}
    kept = {"members": nn.ModuleList(networks), "futures": ComponentState(lambda: table, lambda _: None)}
    RunCheckpoint(kept).save(tmp_path / FOLDER, metadata=metadata_of("motion forecaster", size, 0, 0, 0.0))
    assert [name for name in PARTS if has_component(tmp_path / FOLDER, name)] == ["members"]
    pasts = torch.randn(3, CONTEXT, StateLayout.of_pose_size(size).size)
    expected = motion_forecasts._curves(Members(networks, None, 0.0), pasts[..., :size], made, dataset.humanoid)
    assert torch.equal(ForecastCurves(config, dataset, tmp_path)(pasts), expected)
    seen = pasts[..., :size]
    by_hand = sum(network((seen - network.mean) / network.std) * network.std + network.mean for network in networks)
    torch.testing.assert_close(expected, by_hand.detach() / 2)
    found = with_forecasts(config, dataset, tmp_path).forecasts
    assert found is not None
    assert found.starts.tolist() == [7]


# --- what is known at a frame ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen(folder: Path) -> SimpleNamespace:
    """A blended regressor of the store, all it says the kernels', and what its training is made of."""
    config, store = stored(folder), TakeStore.open(folder / "store")
    humanoid, flow = humanoid_of(config), flow_name(config)
    with pytest.MonkeyPatch.context() as patch, torch_threads(1):
        patch.setattr(blending, "choose_shares", lambda *_: (0.0, 0.9))
        tables, weights = regressor_tables(config, store, humanoid, flow)
    spans = regression._training_spans(config, store)
    starts = torch.cat([torch.arange(s.start + CONTEXT - 1, s.stop) for s in spans])
    return SimpleNamespace(
        config=config, store=store, humanoid=humanoid, flow_name=flow,
        flow=torch.as_tensor(store.flow(flow)[:]).float(), tables=tables, model=load_regressor(weights)[0],
        spans=spans, starts=starts, blocks=regression._blocks(config, store), states=humanoid_state(store.reference),
    )  # fmt: skip


def known(seen: SimpleNamespace, starts: Tensor | None = None) -> Tensor:
    starts = seen.starts if starts is None else starts
    return training_contexts(seen.config, seen.store, seen.humanoid, seen.flow_name, starts, CONTEXT)


def known_by(seen: SimpleNamespace, **other: Any) -> Tensor:
    """As :func:`known`, with another flow, other true states, or another network's."""
    given: dict[str, Any] = {
        "model": seen.model, "crossed_states": torch.zeros_like(seen.states), "flow": seen.flow, "states": seen.states,
        "takes": [Span(t.offset, t.offset + t.length) for t in seen.store.takes], "fragments": seen.spans,
        "blocks": seen.blocks, "humanoid": seen.humanoid, "settings": regression._settings(seen.config),
        "kernel_settings": from_mapping(KernelSettings, seen.config["regressor"]["kernel"], "x"),
        "starts": seen.starts, "context": CONTEXT,
    }  # fmt: skip
    return past_contexts(**{**given, **other})


def whole_takes(seen: SimpleNamespace, flow: Tensor) -> Tensor:
    settled = regression._settings(seen.config)
    return predict_takes(seen.model, flow, seen.spans, settled)["humanoid_state"]


def test_contexts_of_a_blended_regressor_are_what_it_says_of_them_as_clips(
    seen: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    apart = known(seen)
    monkeypatch.setattr(past, "without_block", lambda fragments, *_: list(fragments))
    rows, order = known(seen), torch.randperm(len(seen.starts))
    wanted = context_states(seen.model, seen.flow, [int(at) - CONTEXT + 1 for at in seen.starts], CONTEXT)
    unit = seen.model.state_std
    torch.testing.assert_close(rows / unit, wanted / unit, atol=3e-3, rtol=0)
    assert ((apart - rows) / unit).abs().amax(dim=(1, 2)).min() > 0.05, "each is of kernels that have not seen it"
    torch.testing.assert_close(known(seen, seen.starts[order]) / unit, rows[order] / unit, atol=1e-4, rtol=0)


def test_nothing_after_a_contexts_last_frame_is_known_in_it(seen: SimpleNamespace) -> None:
    before = known_by(seen)
    for span in (*seen.blocks[0], *seen.blocks[1]):
        last = (span.start + span.stop) // 2
        changed = seen.flow.clone()
        changed[last + 1 : span.stop] += 0.2
        mine = (seen.starts >= span.start) & (seen.starts < span.stop)
        moved = (known_by(seen, flow=changed) - before).abs().amax(dim=(1, 2))
        assert not moved[mine & (seen.starts <= last)].any()
        assert (moved[mine & (seen.starts > last)] > 1e-4).all()
        # The states of whole takes know.
        told, other = (whole_takes(seen, flow) for flow in (seen.flow, changed))
        assert (told - other)[last - 1 : last + 1].abs().amax(1).min() > 1e-4


def test_no_kernel_has_learned_the_poses_about_the_contexts_it_tells_of(seen: SimpleNamespace) -> None:
    before = known_by(seen)
    for span in (*seen.blocks[0], *seen.blocks[1]):
        take = next(s for s in seen.spans if s.start <= span.start < s.stop)
        changed = seen.states.clone()
        changed[max(span.start - CONTEXT, take.start) : min(span.stop + CONTEXT, take.stop)] += 0.5
        mine = (seen.starts >= span.start) & (seen.starts < span.stop)
        rows = known_by(seen, states=changed)
        assert torch.equal(rows[mine], before[mine])
        assert not torch.equal(rows[~mine], before[~mine])


def test_of_the_network_the_cross_fitted_states_of_whole_takes_stand_in(seen: SimpleNamespace) -> None:
    by_kernel = seen.model.normalise(known_by(seen)) / 0.9
    crossed = torch.randn_like(seen.states)
    share, other = seen.model.head.network_share.clone(), seen.model.head.kernel_share.clone()
    try:
        seen.model.head.network_share.fill_(0.3)
        seen.model.head.kernel_share.fill_(0.6)
        found = seen.model.normalise(known_by(seen, crossed_states=crossed))
    finally:
        seen.model.head.network_share.copy_(share)
        seen.model.head.kernel_share.copy_(other)
    frames = seen.starts[:, None] + torch.arange(1 - CONTEXT, 1)
    expected = 0.3 * seen.model.normalise(crossed)[frames] + 0.6 * by_kernel
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=1e-4)


def test_contexts_of_a_network_alone_are_the_tables_states(seen: SimpleNamespace) -> None:
    config = dict(seen.config)
    config["regressor"] = {key: value for key, value in config["regressor"].items() if key != "kernel"}
    table = seen.store.table(regressor_name(config, seen.store, seen.flow_name))["humanoid_state"]
    found = training_contexts(config, seen.store, seen.humanoid, seen.flow_name, torch.tensor([9, 4, 60]), CONTEXT)
    assert found.dtype == torch.float32
    for rows, start in zip(found, (9, 4, 60), strict=True):
        assert torch.equal(rows, table[start - 4 : start + 1])
