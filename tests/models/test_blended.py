"""The kernel regression and the blended F: solved exactly, causal, read back, blind to the frames left out."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.blended_regressor import KERNEL, blended
from helpers.env_stand_in import group
from helpers.small_store import configuration, fill_flow
from hypothesis import given, settings
from hypothesis import strategies as st

from egopose.core.errors import InputError
from egopose.data.preparation import flow_name, humanoid_of, prepare
from egopose.data.spans import Span, group_blocks, without_block
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.causal import CausalRegression
from egopose.inference.video_regression import seen_in
from egopose.models.blended import TimeWindows, blended_regressor, flow_cells
from egopose.models.kernel_regression import KernelRegression, fit_kernel_regression
from egopose.models.regressor import StateRegressor
from egopose.pipeline.regressor import kept_tables, load_regressor, regressor_name, regressor_tables
from egopose.training import blended_regressor as blending
from egopose.training.blended_regressor import KernelSettings, choose_shares, fit_kernels, share_groups, window_table
from egopose.vision.encoders import LightFlowEncoder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("blended")
    prepare(configuration(folder), progress=False, flow=False)
    fill_flow(configuration(folder))
    return folder


LOOKAHEAD = 3


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


# --- the kernel ------------------------------------------------------------------------------------------------------


def test_kernel_ridge_by_its_definition() -> None:
    x, y, new = torch.randn(40, 5), torch.randn(40, 3), torch.randn(7, 5)
    model = fit_kernel_regression(x, y, axes=5, whitening=0.0, ridge=0.2, length=1.5)
    a, b = (((v - x.mean(0)) / x.std(0)).numpy().astype(float) for v in (x, new))
    distance = np.linalg.norm(a[:, None] - a, axis=-1)
    # torch's median is the lower of the two in the middle.
    scale = 1.5 / np.sort(distance.ravel())[(distance.size - 1) // 2]
    kernel = np.exp(-scale * distance) + 0.2 * np.eye(40)
    target = y.double().numpy()
    solved = np.linalg.solve(kernel, target - target.mean(0))
    expected = np.exp(-scale * np.linalg.norm(b[:, None] - a, axis=-1)) @ solved + target.mean(0)
    np.testing.assert_allclose(model(new), expected, atol=1e-4)


def test_without_a_ridge_it_passes_through_what_it_learned_and_far_away_it_is_the_mean() -> None:
    x, y = torch.randn(30, 4), torch.randn(30, 2)
    model = fit_kernel_regression(x, y, axes=4, whitening=0.5, ridge=1e-6, length=1.0)
    torch.testing.assert_close(model(x), y, atol=1e-2, rtol=0)
    short = fit_kernel_regression(x, y, axes=4, whitening=0.5, ridge=1e-6, length=100.0)
    torch.testing.assert_close(short(torch.full((1, 4), 50.0))[0], y.mean(0), atol=1e-3, rtol=0)


def test_the_metric_finds_the_direction_that_matters() -> None:
    x = torch.randn(400, 12)
    y = torch.sin(2 * x[:, :1])
    fits = {"axes": 12, "whitening": 0.5, "ridge": 0.03, "length": 1.0}
    plain = fit_kernel_regression(x[:300], y[:300], **fits)
    fitted = fit_kernel_regression(x[:300], y[:300], **fits, importance=torch.ones(1))
    errors = [float((model(x[300:]) - y[300:]).norm()) for model in (plain, fitted)]
    assert errors[1] < 0.8 * errors[0]
    reach = fitted.projection.norm(dim=1)
    assert reach[0] > 1.5 * reach[1:].max()


def test_inputs_that_never_change_do_no_harm() -> None:
    x = torch.cat([torch.randn(20, 2), torch.ones(20, 3)], dim=1)
    model = fit_kernel_regression(x, torch.randn(20, 2), axes=5, whitening=1.0, ridge=0.1, length=1.0)
    assert model(torch.randn(50, 5)).isfinite().all()
    with pytest.raises(ValueError, match="two rows"):
        fit_kernel_regression(x[:1], torch.zeros(1, 2), axes=2, whitening=0.0, ridge=0.1, length=1.0)


# --- the windows -----------------------------------------------------------------------------------------------------


def test_time_windows_are_gaussian_means_around_their_centres() -> None:
    windows = TimeWindows(reach=4, step=2, width=1.0)
    row = torch.randn(1, 15, 3)
    seen = windows(windows.pad(row))[0]
    offsets = np.arange(-windows.radius, windows.radius + 1)
    for t in (0, 7, 14):
        near = row[0, np.clip(t + offsets, 0, 14)].numpy()
        for k, centre in enumerate(range(-4, 5, 2)):
            weight = np.exp(-0.5 * (offsets - centre) ** 2)
            np.testing.assert_allclose(seen[t, 3 * k : 3 * k + 3], weight @ near / weight.sum(), atol=1e-5)


def regressor() -> StateRegressor:
    encoder = LightFlowEncoder(8, 6, 20.0, (4,)).eval()
    network = StateRegressor(encoder, torch.zeros(115), torch.ones(115), 6, 4, (8,))
    windows = TimeWindows(reach=2, step=2, width=0.5)
    kernel = KernelRegression(3 * 8, 5, 9, 115)
    for buffer in (kernel.projection, kernel.centres, kernel.coefficients):
        buffer.normal_()
    model = blended_regressor(network, [kernel], 2, windows)
    model.head.network_share.fill_(0.4)
    model.head.kernel_share.fill_(0.6)
    return model


@torch.no_grad()
def test_a_blended_regressor_is_the_sum_of_its_parts() -> None:
    model, flow = regressor(), 0.1 * torch.randn(1, 20, 2, 8, 8)
    out = model(flow)
    features = model.encoder.network(flow[0])
    context = torch.cat(
        [model.context.forward_lstm(features)[0], model.context.backward_lstm(features.flip(0))[0].flip(0)], -1
    )
    windows = TimeWindows(reach=2, step=2, width=0.5)
    cells = flow_cells(flow[0], 2)
    expected = 0.4 * model.head.network(context) + 0.6 * model.head.kernel(windows(windows.pad(cells[None]))[0])
    torch.testing.assert_close(out["normalised_state"][0], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("smoothing", [0.0, 1.0])
@torch.no_grad()
def test_frame_by_frame_it_is_what_the_video_up_to_there_shows(smoothing: float) -> None:
    model, frames = regressor(), 17
    features = model.encode(0.1 * torch.randn(frames, 2, 8, 8))
    limits = torch.tensor([[-9.0, 9.0]]).repeat(52, 1)
    causal = CausalRegression(model, limits, LOOKAHEAD, smoothing=smoothing)
    rows = [row for t in range(frames) if (row := causal.push(t, features[t])) is not None] + list(causal.drain())
    known = [model.from_features(features[None, : t + 1])["humanoid_state"][0] for t in range(frames)]
    at_once = model.from_features(features[None], lookahead=LOOKAHEAD)["humanoid_state"][0]
    for t, row in enumerate(rows):
        end = min(t + LOOKAHEAD, frames - 1)
        torch.testing.assert_close(at_once[t], known[end][t], atol=1e-5, rtol=1e-4)
        if not smoothing:
            torch.testing.assert_close(row.humanoid_state, known[end][t], atol=1e-5, rtol=1e-4)
    if smoothing:
        plain = CausalRegression(model, limits, LOOKAHEAD)
        jagged = torch.stack([r.humanoid_state for t in range(frames) if (r := plain.push(t, features[t])) is not None])
        smooth = torch.stack([row.humanoid_state for row in rows])
        assert smooth.diff(dim=0).norm() < jagged.diff(dim=0).norm()


# --- shares ----------------------------------------------------------------------------------------------------------


def test_shares_find_the_mixture_and_trust_noise_with_nothing() -> None:
    truth, take = torch.randn(400, 6), torch.arange(400) // 100
    assert choose_shares(truth, torch.randn(400, 6), truth, take, 0.1) == (1.0, 0.0)
    assert choose_shares(torch.randn(400, 6), torch.randn(400, 6), truth, take, 0.1)[0] <= 0.1
    noise = torch.randn(400, 6)
    first, second = choose_shares(truth + noise, truth - noise, truth, take, 0.1)
    assert (first, second) == (0.5, 0.5)


def test_share_groups_cover_the_state_once_and_judge_no_hand() -> None:
    humanoid = humanoid_of({"humanoid": group("humanoid", "default"), "sim": group("sim", "fast")})
    groups = share_groups(humanoid, torch.ones(115))
    members = torch.cat([columns for columns, _, _ in groups.values()])
    assert sorted(members.tolist()) == list(range(115))
    judged = torch.cat([columns for _, columns, _ in groups.values()]).tolist()
    assert not {StateLayout(52).joint_angles.start + d for d in humanoid.hand_dofs.tolist()} & set(judged)
    assert len(groups["legs"][0]) == 2 * 14


@given(st.lists(st.tuples(st.integers(1, 50), st.integers(0, 4)), min_size=1, max_size=12), st.integers(2, 6))
@settings(max_examples=50, deadline=None)
def test_group_blocks_part_nogroup(made: list[tuple[int, int]], folds: int) -> None:
    starts = np.cumsum([0, *(length for length, _ in made)])
    fragments = [Span(int(a), int(b)) for a, b in itertools.pairwise(starts)]
    groups = [group for _, group in made]
    blocks = group_blocks(fragments, groups, folds)
    assert sorted(span for block in blocks for span in block) == fragments
    assert len(blocks) == min(folds, len(set(groups)))
    found = [{groups[fragments.index(span)] for span in block} for block in blocks]
    assert sum(len(names) for names in found) == len(set(groups))
    for block in blocks:
        left = without_block(fragments, block, 3, 3)
        assert not set(left) & set(block)


# --- in a store ------------------------------------------------------------------------------------------------------


def test_a_store_makes_keeps_and_reads_back_a_blended_regressor(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Flow of chance tells nothing: either share would be nought, and nothing of the kernel be compared.
    monkeypatch.setattr(blending, "choose_shares", lambda *_: (0.3, 0.6))
    config = blended(folder)
    store, humanoid, flow = TakeStore.open(folder / "store"), humanoid_of(config), flow_name(config)
    tables, weights = regressor_tables(config, store, humanoid, flow)
    network = {**config, "regressor": {k: v for k, v in config["regressor"].items() if k != "kernel"}}
    assert store.has_table(regressor_name(network, store, flow)), "the network by itself is the store's too"
    card = store.table_card(regressor_name(config, store, flow))
    assert {tuple(pair) for pair in card["shares"].values()} == {(0.3, 0.6)}

    # On training frames neither part has seen the frame; elsewhere the loaded weights say the same.
    model, source_config = load_regressor(weights)
    kernel_settings = KernelSettings(**KERNEL)
    whole = [Span(t.offset, t.offset + t.length) for t in store.takes]
    half = [Span(s.start, s.start + round((s.stop - s.start) / 2)) for s in whole]
    table = window_table(store.flow(flow), whole, kernel_settings, 64)
    wanted = model.normalise(humanoid_state(store.reference))
    block = [Span(s.start, s.start + (s.stop - s.start) // 2) for s in half]
    importance = torch.zeros(115)
    importance[StateLayout(52).joint_angles][[d for d in range(52) if d not in humanoid.hand_dofs]] = 1.0
    importance *= model.state_std
    (kernel,) = fit_kernels(table, wanted, without_block(half, block, 2, 2), kernel_settings, importance, None)
    by_network = model.normalise(regressor_tables(network, store, humanoid, flow)[0]["humanoid_state"])
    for span in block:
        rows = slice(span.start, span.stop)
        expected = model.head.network_share * by_network[rows] + model.head.kernel_share * kernel(table[rows])
        found = model.normalise(tables["humanoid_state"][rows])
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
    seen = seen_in(humanoid, model, np.asarray(store.flow(flow)[whole[0].start : whole[0].stop]), source_config)
    tail = slice(half[0].stop, whole[0].stop)
    torch.testing.assert_close(torch.as_tensor(seen["humanoid_state"])[tail], tables["humanoid_state"][tail])
    assert tables["visual_context"].shape[1] == tables["humanoid_state"].shape[1]

    again, _ = kept_tables(config, store, humanoid, flow, weights)
    assert torch.equal(again["humanoid_state"], tables["humanoid_state"])


def test_a_blended_regressor_needs_cross_fitting(folder: Path) -> None:
    config = blended(folder)
    config["regressor"]["cross_fit"] = 1
    store = TakeStore.open(folder / "store")
    with pytest.raises(InputError, match="cross_fit"):
        regressor_tables(config, store, humanoid_of(config), flow_name(config))


@pytest.mark.parametrize(
    ("key", "value"), [("step", 3), ("width", 0.0), ("centres", 1), ("share_step", 0.0), ("cells", 0)]
)
def test_settings_that_make_no_kernel_are_named(key: str, value: float) -> None:
    with pytest.raises(InputError, match=key):
        KernelSettings(**{**KERNEL, key: value})
