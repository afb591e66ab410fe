"""Kernels of several sets of time windows that learn mirror images too: by formula, by symmetry, in a store."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.blended_regressor import KERNEL, blended
from helpers.env_stand_in import group
from helpers.frame_by_frame import assert_frame_by_frame_as_the_video_up_to_there
from helpers.small_store import configuration, fill_flow
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from egopose.checkpoint.body_parts import load_body_part_estimator
from egopose.checkpoint.checkpoint import read_json
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.data.preparation import flow_name, humanoid_of, prepare
from egopose.data.spans import Span, cross_fit_blocks, without_block
from egopose.data.store import TakeStore
from egopose.envs.mdp.observations import humanoid_state
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.state_layout import StateLayout
from egopose.inference.video_regression import seen_in
from egopose.models.blended import MeanOfKernels, TimeWindows, blended_regressor
from egopose.models.kernel_regression import KernelRegression, fit_kernel_regression
from egopose.models.mirror import StateMirror, state_mirror
from egopose.models.regressor import StateRegressor
from egopose.pipeline.regressor import load_regressor, regressor_name, regressor_tables
from egopose.training import blended_regressor as blending
from egopose.training.blended_regressor import KernelSettings, fit_kernels, window_table
from egopose.training.body_parts import posture_mirror, save_body_part_estimator
from egopose.vision.body_parts import BodyPartEstimator, as_plane
from egopose.vision.encoders import LightFlowEncoder
from egopose.vision.flow import FlowConfig

ALSO = ((6, 3, 1.0), (0, 1, 1.5))
COUNTS = (3, 5, 1)
SETTINGS = KernelSettings(**KERNEL, also=ALSO, mirror=True)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def humanoid() -> HumanoidModel:
    return humanoid_of({"humanoid": group("humanoid", "default"), "sim": group("sim", "fast")})


# --- several sets of windows -----------------------------------------------------------------------------------------

WINDOW_SETS = st.lists(
    st.tuples(st.integers(0, 3), st.integers(1, 4), st.floats(0.4, 3.0)).map(lambda s: (s[0] * s[1], s[1], s[2])),
    min_size=1,
    max_size=4,
)


@given(WINDOW_SETS)
@settings(max_examples=30, deadline=None)
def test_each_set_of_windows_is_what_it_is_by_itself(sets: list[tuple[int, int, float]]) -> None:
    windows = TimeWindows(*sets[0], sets[1:])
    alone = [TimeWindows(*one) for one in sets]
    assert windows.counts == [1 + 2 * reach // step for reach, step, _ in sets] == [one.count for one in alone]
    assert windows.count == sum(windows.counts)
    assert windows.radius == max(reach + math.ceil(3 * width) for reach, _, width in sets)

    frames = 2 * windows.radius + 4
    row = 2 * torch.rand(2, frames, 3, generator=torch.Generator().manual_seed(1)) - 1
    seen = windows(windows.pad(row))
    assert seen.shape == (2, frames, 3 * windows.count)
    inner = slice(windows.radius, frames - windows.radius)
    for one, part in zip(alone, seen.split([3 * one.count for one in alone], dim=-1), strict=True):
        # By itself the tail ends three widths past its centre, beyond which lies at most .27 % of it.
        atol = 1e-6 if one.radius == windows.radius else 0.006
        torch.testing.assert_close(part[:, inner], one(one.pad(row))[:, inner], atol=atol, rtol=0)


def test_windows_of_all_sets_are_gaussian_means_one_set_after_another() -> None:
    windows = TimeWindows(2, 2, 0.5, ALSO)
    assert (windows.counts, windows.radius) == (list(COUNTS), 9)
    row = torch.randn(1, 24, 2)
    seen = windows(windows.pad(row))[0].reshape(24, 9, 2)
    offsets = np.arange(-9, 10)
    centres, widths = [-2, 0, 2, -6, -3, 0, 3, 6, 0], [0.5] * 3 + [1.0] * 5 + [1.5]
    for t in (0, 12, 23):
        near = row[0, np.clip(t + offsets, 0, 23)].numpy()
        for k, (centre, width) in enumerate(zip(centres, widths, strict=True)):
            weight = np.exp(-0.5 * ((offsets - centre) / width) ** 2)
            np.testing.assert_allclose(seen[t, k], weight @ near / weight.sum(), atol=1e-5)


# --- several kernels -------------------------------------------------------------------------------------------------


def kernel_of_chance(inputs: int) -> KernelRegression:
    kernel = KernelRegression(inputs, 5, 9, 115)
    for buffer in (kernel.input_mean, kernel.projection, kernel.centres, kernel.coefficients, kernel.output_mean):
        buffer.normal_()
    return kernel


def regressor(counts: tuple[int, ...] = COUNTS) -> StateRegressor:
    network = StateRegressor(LightFlowEncoder(8, 6, 20.0, (4,)).eval(), torch.zeros(115), torch.ones(115), 6, 4, (8,))
    kernels = [kernel_of_chance(8 * count) for count in counts]
    model = blended_regressor(network, kernels, 2, TimeWindows(2, 2, 0.5, ALSO))
    model.head.network_share.fill_(0.4)
    model.head.kernel_share.fill_(0.6)
    return model


def test_several_kernels_say_the_mean_of_what_each_says_of_its_own_numbers() -> None:
    kernels = [kernel_of_chance(size) for size in (4, 7, 2)]
    rows = torch.randn(2, 6, 13)
    parts = [rows[..., :4], rows[..., 4:11], rows[..., 11:]]
    expected = sum(kernel(part) for kernel, part in zip(kernels, parts, strict=True)) / 3
    torch.testing.assert_close(MeanOfKernels(kernels)(rows), expected)
    torch.testing.assert_close(MeanOfKernels(kernels[:1])(parts[0]), kernels[0](parts[0]), rtol=0, atol=0)


@pytest.mark.parametrize("counts", [COUNTS[:1], COUNTS[:2], (*COUNTS, 1)])
def test_another_number_of_kernels_than_of_sets_is_refused(counts: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"3 sets of windows need as many kernels, not {len(counts)}"):
        regressor(counts)


@torch.no_grad()
def test_frame_by_frame_three_sets_show_what_the_video_up_to_there_does() -> None:
    model = regressor()
    assert_frame_by_frame_as_the_video_up_to_there(model, model.encode(0.1 * torch.randn(24, 2, 8, 8)))


# --- mirror images of limbs ------------------------------------------------------------------------------------------


def mirroring_finder(pairs: int, single: int, seed: int) -> BodyPartEstimator:
    """Numbers that change places in pairs, of either sign, and others that stay; each with a scale of its own."""
    numbers, generator = 2 * pairs + single, torch.Generator().manual_seed(seed)
    finder = BodyPartEstimator(numbers, 8)
    order = torch.randperm(numbers, generator=generator)
    first, second = order[: 2 * pairs].chunk(2)
    finder.mirror_index[first], finder.mirror_index[second] = second, first
    signs = torch.randint(0, 2, (numbers,), generator=generator) * 2.0 - 1.0
    signs[second] = signs[first]
    finder.mirror_sign.copy_(signs)
    finder.mean.normal_(generator=generator)
    finder.std.uniform_(0.1, 3.0, generator=generator)
    return finder


@given(st.integers(0, 5), st.integers(1, 5), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_limbs_mirrored_are_mirrored_in_the_units_of_their_numbers(pairs: int, single: int, seed: int) -> None:
    finder = mirroring_finder(pairs, single, seed)
    rows = torch.randn(3, 4, 2 * finder.numbers, generator=torch.Generator().manual_seed(seed + 1))
    image = finder.mirrored_rows(rows)
    torch.testing.assert_close(finder.mirrored_rows(image), rows, atol=1e-4, rtol=1e-4)

    def own_units(seen: Tensor) -> tuple[Tensor, Tensor]:
        posture, log_variance = seen.double().chunk(2, -1)
        return posture * finder.std + finder.mean, log_variance.exp() * finder.std**2

    (posture, variance), (other, other_variance) = own_units(rows), own_units(image)
    for number, (source, sign) in enumerate(zip(finder.mirror_index, finder.mirror_sign, strict=True)):
        torch.testing.assert_close(other[..., number], sign * posture[..., source], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(other_variance[..., number], variance[..., source], atol=0.0, rtol=1e-4)


def test_rows_as_kept_are_mirrored_in_single_precision() -> None:
    rows = torch.randn(5, 2 * 89).half()
    image = load_body_part_estimator("body_parts").mirrored_rows(rows)
    assert image.dtype == torch.float32
    torch.testing.assert_close(
        image, load_body_part_estimator("body_parts").mirrored_rows(rows.float()), rtol=0, atol=0
    )


def test_the_shipped_finder_mirrors_as_the_humanoid_does(humanoid: HumanoidModel) -> None:
    finder, mirror = load_body_part_estimator("body_parts"), posture_mirror(humanoid.skeleton)
    assert torch.equal(finder.mirror_index, mirror.index)
    assert torch.equal(finder.mirror_sign, mirror.sign)
    rows = torch.randn(20, 2 * finder.numbers)
    torch.testing.assert_close(finder.mirrored_rows(finder.mirrored_rows(rows)), rows, atol=1e-4, rtol=1e-4)
    posture = (rows[:, :89] * finder.std + finder.mean).double()
    image = finder.mirrored_rows(rows)[:, :89].double() * finder.std + finder.mean
    torch.testing.assert_close(image, mirror.state(posture), atol=1e-5, rtol=1e-5)


def test_a_finder_read_back_mirrors_as_before(
    humanoid: HumanoidModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, mirror = BodyPartEstimator(89, 8), posture_mirror(humanoid.skeleton)
    model.mean.normal_()
    model.std.uniform_(0.1, 2.0)
    save_body_part_estimator(tmp_path / "kept", model, humanoid.skeleton, FlowConfig("fast", 64, 32), {}, 1)
    monkeypatch.setattr("egopose.checkpoint.body_parts.FOLDER", tmp_path)
    again = load_body_part_estimator.__wrapped__("kept")
    assert torch.equal(again.mirror_index, mirror.index)
    assert torch.equal(again.mirror_sign, mirror.sign)
    rows = torch.randn(4, 2 * 89)
    model.mirror_index.copy_(mirror.index)
    model.mirror_sign.copy_(mirror.sign)
    torch.testing.assert_close(again.mirrored_rows(rows), model.mirrored_rows(rows), rtol=0, atol=0)


# --- mirror images of clips ------------------------------------------------------------------------------------------


def mirrored_clip(flow: np.ndarray) -> np.ndarray:
    """The right edge is the left one, and what moved right moves left."""
    image = flow[..., ::-1].copy()
    image[:, 0] *= -1
    return image


@pytest.mark.parametrize("cells", [2, 3])
@pytest.mark.parametrize("limbs", [None, "body_parts"])
def test_the_table_of_the_mirror_image_is_the_table_of_the_mirrored_clip(limbs: str | None, cells: int) -> None:
    chosen, draw = replace(SETTINGS, body_parts=limbs, cells=cells), np.random.default_rng(5)
    flow = draw.normal(size=(40, 2, 14, 14)).astype(np.float32)
    image = mirrored_clip(flow)
    if limbs is not None:
        rows = torch.from_numpy(draw.normal(size=(40, 2 * 89)).astype(np.float32))
        seen = (rows, load_body_part_estimator(limbs).mirrored_rows(rows))
        flow, image = (
            np.concatenate([a, as_plane(b.numpy(), 14)], axis=1) for a, b in zip((flow, image), seen, strict=True)
        )
    takes = [Span(0, 17), Span(20, 40)]
    table = window_table(flow, takes, chosen, 6, mirrored=True)
    torch.testing.assert_close(table, window_table(image, takes, chosen, 64), atol=1e-5, rtol=1e-5)
    assert table.shape[1] == sum(chosen.input_sizes())
    assert chosen.input_sizes() == [count * (2 * cells**2 + (178 if limbs else 0)) for count in COUNTS]
    assert not table[17:20].any()
    assert (table - window_table(flow, takes, chosen, 64)).abs().max() > 0.3


# --- kernels that learn mirror images --------------------------------------------------------------------------------


class Scene:
    """Flow of chance and states of chance, with the mirror image of both."""

    def __init__(self, frames: int, mirror: StateMirror) -> None:
        flow = torch.randn(frames, 2, 8, 8).numpy()
        self.table = window_table(flow, [Span(0, frames)], SETTINGS, 64)
        self.image_table = window_table(mirrored_clip(flow), [Span(0, frames)], SETTINGS, 64)
        self.states = torch.randn(frames, len(mirror.index))
        self.image = (self.image_table, mirror.state(self.states))


@pytest.fixture
def mirror(humanoid: HumanoidModel) -> StateMirror:
    return state_mirror(humanoid.skeleton)


def even_importance(mirror: StateMirror) -> Tensor:
    """Of chance for the angles, the same for a number and its image."""
    chance = torch.zeros(len(mirror.index))
    chance[StateLayout(52).joint_angles] = torch.rand(52)
    return chance + chance[mirror.index]


def test_kernels_that_learn_the_image_answer_the_mirrored_scene_with_the_mirrored_state(mirror: StateMirror) -> None:
    known, new, importance = Scene(60, mirror), Scene(20, mirror), even_importance(mirror)
    chosen = replace(SETTINGS, metric_rows=120)
    spans = [Span(0, 25), Span(25, 60)]
    fits = {
        with_image: MeanOfKernels(fit_kernels(known.table, known.states, spans, chosen, importance, image))
        for with_image, image in ((True, known.image), (False, None))
    }
    both = fits[True]
    torch.testing.assert_close(both(new.image_table), mirror.state(both(new.table)), atol=2e-4, rtol=0)
    for kernel, size in zip(both.kernels, both.sizes, strict=True):
        assert kernel.centres.shape == (120, 6)
        assert size == kernel.projection.shape[0]
    assert both(new.table).std() > 0.05, "it is no constant that is its own image"
    apart = fits[False](new.image_table) - mirror.state(fits[False](new.table))
    assert apart.abs().max() > 0.1
    torch.testing.assert_close(both(known.image_table), mirror.state(both(known.table)), atol=2e-4, rtol=0)
    assert torch.nn.functional.cosine_similarity(both(known.table), known.states).min() > 0.9


@pytest.mark.parametrize("centres", [120, 41, 2])
def test_the_centres_are_shared_between_frames_and_their_images(mirror: StateMirror, centres: int) -> None:
    known, importance = Scene(60, mirror), even_importance(mirror)
    chosen, spans = replace(SETTINGS, centres=centres, also=ALSO[:1]), [Span(3, 20), Span(30, 60)]
    there = np.concatenate([np.arange(3, 20), np.arange(30, 60)])
    half = min(centres // 2, len(there))
    frames = torch.from_numpy(there[np.linspace(0, len(there) - 1, half).round().astype(int)])
    kernels = fit_kernels(known.table, known.states, spans, chosen, importance, known.image)
    assert len(kernels) == 2
    outputs = torch.cat([known.states[frames], known.image[1][frames]])
    for kernel, columns in zip(kernels, (slice(0, 24), slice(24, 64)), strict=True):
        inputs = torch.cat([known.table[frames, columns], known.image_table[frames, columns]])
        assert len(kernel.centres) == 2 * half
        torch.testing.assert_close(kernel.centres, kernel.project(inputs), atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(kernel.output_mean, outputs.mean(0), atol=1e-5, rtol=1e-4)
        alone = fit_kernel_regression(
            inputs, outputs, axes=6, whitening=0.5, ridge=0.03, length=1.0, importance=importance, metric_rows=50
        )
        torch.testing.assert_close(
            kernel(known.table[:, columns]), alone(known.table[:, columns]), atol=1e-4, rtol=1e-4
        )


def test_without_images_all_centres_are_frames(mirror: StateMirror) -> None:
    known = Scene(60, mirror)
    chosen = replace(SETTINGS, centres=41, mirror=False)
    kernels = fit_kernels(known.table, known.states, [Span(0, 60)], chosen, even_importance(mirror), None)
    frames = torch.from_numpy(np.linspace(0, 59, 41).round().astype(int))
    assert [len(kernel.centres) for kernel in kernels] == [41, 41, 41]
    torch.testing.assert_close(kernels[2].centres, kernels[2].project(known.table[frames, 64:]), atol=1e-4, rtol=1e-4)


# --- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("also", "named"),
    [
        (((3, 2, 1.0),), "also"),
        (((4, 2, 1.0), (4, 0, 1.0)), "also"),
        (((-2, 2, 1.0),), "also"),
        (((4, 2, 0.0),), "width"),
        (((4, 2, 1.0), (4, 4, -1.0)), "width"),
    ],
)
def test_sets_of_windows_that_cannot_be_are_named(also: tuple[tuple[int, int, float], ...], named: str) -> None:
    with pytest.raises(InputError, match=f"kernel: {named}: "):
        KernelSettings(**KERNEL, also=also)


def test_sets_of_windows_are_read_from_lists() -> None:
    read = from_mapping(KernelSettings, {**KERNEL, "also": [[6, 3, 1], [0, 1, 1.5]], "mirror": True}, "x")
    assert read == SETTINGS
    assert read.windows().counts == list(COUNTS)
    with pytest.raises(InputError, match="also"):
        from_mapping(KernelSettings, {**KERNEL, "also": [[6, 3]]}, "x")
    plain = from_mapping(KernelSettings, KERNEL, "x")
    assert (plain.also, plain.mirror) == ((), False)


# --- in a store ------------------------------------------------------------------------------------------------------

STORED: dict[str, Any] = {**KERNEL, "also": [[4, 4, 1.0], [0, 1, 0.5]], "mirror": True, "axes": 20, "centres": 31}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mirrored")
    prepare(configuration(folder), progress=False, flow=False)
    fill_flow(configuration(folder))
    return folder


def test_a_store_makes_keeps_and_reads_back_mirrored_kernels_of_several_sets(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Flow of chance tells nothing: either share would be nought, and nothing of the kernels be compared.
    monkeypatch.setattr(blending, "choose_shares", lambda *_: (0.3, 0.6))
    config = blended(folder)
    config["regressor"] |= {"kernel": STORED, "epochs": 1}
    store, humanoid, flow = TakeStore.open(folder / "store"), humanoid_of(config), flow_name(config)
    tables, weights_folder = regressor_tables(config, store, humanoid, flow)
    saved = read_json(weights_folder, "config")
    assert (saved["centres"], saved["axes"]) == (30, [20, 20, 8])
    assert store.table_card(regressor_name(config, store, flow))["centres"] == 30
    model, source_config = load_regressor(weights_folder)
    assert [kernel.centres.shape for kernel in model.head.kernel.kernels] == [(30, 20), (30, 20), (30, 8)]

    chosen = from_mapping(KernelSettings, STORED, "x")
    whole = [Span(t.offset, t.offset + t.length) for t in store.takes]
    half = [Span(s.start, s.start + round((s.stop - s.start) / 2)) for s in whole]
    table, mirrored = (window_table(store.flow(flow), whole, chosen, 64, mirrored=image) for image in (False, True))
    states = humanoid_state(store.reference)
    image = (mirrored, model.normalise(state_mirror(humanoid.skeleton).state(states)))
    wanted = model.normalise(states)
    importance = torch.zeros(115)
    importance[StateLayout(52).joint_angles][[d for d in range(52) if d not in humanoid.hand_dofs]] = 1.0
    importance *= model.state_std
    network = {**config, "regressor": {k: v for k, v in config["regressor"].items() if k != "kernel"}}
    by_network = model.normalise(regressor_tables(network, store, humanoid, flow)[0]["humanoid_state"])
    for block in cross_fit_blocks(half, 2):
        others = without_block(half, block, 2, 2)
        kernels = MeanOfKernels(fit_kernels(table, wanted, others, chosen, importance, image))
        for span in block:
            rows = slice(span.start, span.stop)
            expected = 0.3 * by_network[rows] + 0.6 * kernels(table[rows])
            found = model.normalise(tables["humanoid_state"][rows])
            torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)

    on_all = MeanOfKernels(fit_kernels(table, wanted, half, chosen, importance, image))
    torch.testing.assert_close(model.head.kernel(table), on_all(table), atol=1e-4, rtol=1e-4)
    for take, train in zip(whole, half, strict=True):
        seen = seen_in(humanoid, model, np.asarray(store.flow(flow)[take.start : take.stop]), source_config)
        found = torch.as_tensor(seen["humanoid_state"])[train.stop - take.start :]
        torch.testing.assert_close(found, tables["humanoid_state"][train.stop : take.stop])
