"""Limbs in the picture as a regressor sees them: the same offline, live and from a store, and only by its kernel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.blended_regressor import KERNEL, blended
from helpers.frame_by_frame import assert_frame_by_frame_as_the_video_up_to_there
from helpers.live_stand_in import run_config, untrained, write_walk
from helpers.small_store import configuration, fill_flow

from egopose.checkpoint.body_parts import load_body_part_estimator
from egopose.core.config import compose_config, from_mapping
from egopose.core.errors import InputError
from egopose.data.preparation import flow_name, humanoid_of, prepare
from egopose.data.store import TakeStore
from egopose.inference.stream import build
from egopose.inference.stream.build import load_forecaster
from egopose.inference.stream.frame_features import FrameFeatures
from egopose.models.blended import TimeWindows, blended_regressor, flow_cells, kernel_view
from egopose.models.kernel_regression import KernelRegression
from egopose.models.predictions import take_frames
from egopose.models.regressor import StateRegressor
from egopose.pipeline import regressor as regression
from egopose.pipeline import regressor_input as sight
from egopose.pipeline.regressor import kept_tables, load_regressor, regressor_name, regressor_tables
from egopose.pipeline.regressor_input import (
    FlowAndBodyParts,
    body_part_estimator_name,
    body_part_fingerprint,
    load_body_part_estimator_of,
    planes_of,
    seen_in_store,
)
from egopose.training import blended_regressor as blending
from egopose.training.blended_regressor import KernelSettings
from egopose.vision.body_parts import BodyPartEstimator, as_plane, body_part_rows
from egopose.vision.encoders import LightFlowEncoder
from egopose.vision.features import extract_body_parts, extract_flow
from egopose.vision.film import small_picture
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera
from egopose.vision.video import iter_frames

FLOW = FlowConfig(preset="ultrafast", working_size=128, stored_size=32, workers=1)
CAMERA = Camera(field_of_view=110.0, lens="fisheye", readout=0.02)
LIMBS, PLACES = 5, 64  # numbers that count, and all there are, of the regressor below


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def finder_of_chance(numbers: int = 6, seed: int = 3) -> BodyPartEstimator:
    """Untrained; that its answers are far apart for pictures that are is all that is wanted of it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        finder = BodyPartEstimator(numbers, 16).eval()
        finder.posture.weight.data *= 20.0
    return finder


@pytest.fixture(scope="module")
def finder() -> BodyPartEstimator:
    return finder_of_chance()


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("seen") / "walk.mp4", 12)


# --- pictures and rows -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("height", "width"), [(128, 200), (200, 128)])
def test_a_small_picture_is_the_area_mean_of_the_centred_square(height: int, width: int) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    square = frame[:, 36:164] if width > height else frame[36:164]
    wanted = square.reshape(64, 2, 64, 2, 3).astype(float).mean((1, 3))
    assert np.abs(small_picture(frame).astype(float) - wanted).max() <= 0.5
    small = square[:64, :64]
    np.testing.assert_array_equal(small_picture(small), small)
    assert small_picture(square[:20, :30]).shape == (64, 64, 3)


def test_each_row_is_of_a_frame_and_the_one_before_in_whatever_batch(
    finder: BodyPartEstimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = np.random.default_rng(1)
    pictures = draw.integers(0, 256, (9, 64, 64, 3), dtype=np.uint8)
    flow = (0.05 * draw.normal(size=(9, 2, 32, 32))).astype(np.float16)
    rows = body_part_rows(finder, pictures, flow)
    assert rows.dtype == np.float16
    monkeypatch.setattr("egopose.vision.body_parts._BATCH", 4)
    np.testing.assert_allclose(body_part_rows(finder, list(pictures), flow), rows, atol=4e-3)
    for frame, before in ((0, 0), (1, 0), (4, 3), (8, 7)):
        pair = (torch.from_numpy(pictures[i]).permute(2, 0, 1)[None] for i in (before, frame))
        with torch.no_grad():
            _, *found = finder(*pair, torch.from_numpy(flow[frame : frame + 1]))
        np.testing.assert_allclose(rows[frame], torch.cat(found, 1)[0], atol=4e-3)
    assert np.abs(np.diff(rows[:, :6].astype(float), axis=0)).max() > 0.1


def test_flow_of_another_size_is_brought_to_the_finders(finder: BodyPartEstimator) -> None:
    pictures = np.random.default_rng(2).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    coarse = (0.05 * np.random.default_rng(3).normal(size=(6, 4, 4))).astype(np.float32)
    large, small = (np.stack([cv2.resize(c, (n, n)) for c in coarse]).reshape(3, 2, n, n) for n in (64, 32))
    wanted = body_part_rows(finder, pictures, small)
    np.testing.assert_allclose(body_part_rows(finder, pictures, large), wanted, atol=0.03)
    assert np.abs(body_part_rows(finder, pictures, -large) - wanted).max() > 0.3


def test_rows_fill_a_plane_in_reading_order() -> None:
    rows = np.arange(1, 19, dtype=np.float16).reshape(2, 9)
    plane = as_plane(rows, 4)
    assert (plane.shape, plane.dtype) == ((2, 1, 4, 4), np.float16)
    np.testing.assert_array_equal(plane.reshape(2, 16)[:, :9], rows)
    assert not plane.reshape(2, 16)[:, 9:].any()
    np.testing.assert_array_equal(as_plane(rows, 3).reshape(2, 9), rows)
    with pytest.raises(ValueError, match="5 numbers do not fit"):
        as_plane(rows[:, :5], 2)


def test_flow_and_limbs_read_as_one_table() -> None:
    flow, rows = torch.randn(20, 2, 4, 4).half(), torch.randn(20, 7).half()
    table = FlowAndBodyParts(flow, rows)
    whole = np.concatenate([flow, as_plane(rows.numpy(), 4)], axis=1)
    assert (len(table), table.ndim) == (20, 4)
    for frames in (slice(None), slice(3, 9), np.array([7, 2, 2, 19])):
        np.testing.assert_array_equal(table[frames], whole[frames])
    np.testing.assert_array_equal(take_frames(table, np.array([5, 1])), whole[[5, 1]])


# --- from videos -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_flow_with_limbs_is_flow_and_the_limbs_beside_it(
    finder: BodyPartEstimator, walk: Path, camera: Camera | None
) -> None:
    offset = 0.0 if camera is None else 0.5 * camera.readout
    flow = extract_flow(walk, FLOW, 30.0, offset, camera=camera)
    rows = extract_body_parts(walk, flow, FLOW, finder, 30.0, offset, camera)
    both = extract_flow(walk, FLOW, 30.0, offset, camera=camera, finder=finder)
    assert (both.shape, both.dtype) == ((12, 3, 32, 32), np.float16)
    np.testing.assert_array_equal(both, np.concatenate([flow, as_plane(rows, 32)], axis=1))

    frames = list(iter_frames(walk, 30.0))
    if camera is not None:
        seen = camera.rectifier(frames[0].shape[1], frames[0].shape[0], FLOW.working_size)
        frames = [seen(frame) for frame in frames]
    np.testing.assert_array_equal(rows, body_part_rows(finder, [small_picture(frame) for frame in frames], flow))
    if camera is not None:
        bent = extract_body_parts(walk, flow, FLOW, finder, 30.0, 0.0, None)
        assert np.abs(bent - rows).max() > 0.1, "the lens is undone before limbs are looked for"


@pytest.mark.parametrize(("camera", "side"), [(None, 32), (CAMERA, 64)])
def test_live_the_limbs_are_those_seen_offline(
    finder: BodyPartEstimator, walk: Path, camera: Camera | None, side: int
) -> None:
    flow = replace(FLOW, stored_size=side)
    offset = 0.0 if camera is None else 0.5 * camera.readout
    offline = extract_flow(walk, flow, 30.0, offset, camera=camera, finder=finder)
    live = FrameFeatures(None, flow, camera or Camera(), 30.0, finder)
    seen = np.stack([live.flow(image, t / 30) for t, image in enumerate(iter_frames(walk, 30.0))])
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[:, :2], offline[:, :2], atol=1e-3)
    # The flow is rounded to float16 in one of them before the finder sees it.
    np.testing.assert_allclose(seen[:, 2], offline[:, 2], atol=0.02)
    assert np.abs(np.diff(offline[:, 2].astype(float), axis=0)).max() > 0.2


def test_live_a_source_that_comes_back_in_another_size_has_no_picture_before(
    finder: BodyPartEstimator, walk: Path
) -> None:
    frames = list(iter_frames(walk, 30.0))
    other = cv2.resize(frames[9], (160, 160))
    live, fresh = (FrameFeatures(None, FLOW, Camera(), 30.0, finder) for _ in range(2))
    for t in range(3):
        live.flow(frames[t], t / 30)
    np.testing.assert_array_equal(live.flow(other, 0.1), fresh.flow(other, 0.0))


# --- in a regressor --------------------------------------------------------------------------------------------------


def test_a_kernel_looks_at_the_planes_it_was_made_for() -> None:
    seen = torch.randn(4, 3, 8, 8)
    view = kernel_view(seen, 2, LIMBS)
    torch.testing.assert_close(view, torch.cat([flow_cells(seen[:, :2], 2), seen[:, 2].flatten(1)[:, :LIMBS]], 1))
    torch.testing.assert_close(kernel_view(seen[:, :2], 2, 0), flow_cells(seen[:, :2], 2))
    with pytest.raises(ValueError, match="flow and limbs"):
        kernel_view(seen[:, :2], 2, LIMBS)
    with pytest.raises(ValueError, match="flow alone"):
        kernel_view(seen, 2, 0)


def regressor() -> StateRegressor:
    network = StateRegressor(LightFlowEncoder(8, 6, 20.0, (4,)).eval(), torch.zeros(115), torch.ones(115), 6, 4, (8,))
    kernel = KernelRegression(3 * (8 + LIMBS), 5, 9, 115)
    for buffer in (kernel.projection, kernel.centres, kernel.coefficients):
        buffer.normal_()
    model = blended_regressor(network, [kernel], 2, TimeWindows(reach=2, step=2, width=0.5), LIMBS)
    model.head.network_share.fill_(0.4)
    model.head.kernel_share.fill_(0.6)
    return model


def frames_seen(frames: int) -> torch.Tensor:
    return torch.cat([0.1 * torch.randn(frames, 2, 8, 8), torch.randn(frames, 1, 8, 8)], dim=1)


@pytest.mark.parametrize("at", [0, 9, 18])
@torch.no_grad()
def test_limbs_are_seen_around_their_frame_by_the_kernel_alone(at: int) -> None:
    model, seen = regressor(), frames_seen(20)
    radius, own = model.context.windows.radius, model.context.network_output
    assert radius == 4
    other = seen.clone()
    other[at, 2].flatten()[:LIMBS] += 50.0
    before, after = model(seen[None]), model(other[None])
    near = (torch.arange(20) - at).abs() <= radius
    for key in ("visual_context", "normalised_state"):
        moved = (after[key] - before[key])[0].abs().amax(1)
        assert (moved[near] > 1e-5).all(), key
        assert not moved[~near].any(), key
    assert torch.equal(after["visual_context"][..., :own], before["visual_context"][..., :own])
    model.head.kernel_share.zero_()
    assert torch.equal(model(other[None])["normalised_state"], model(seen[None])["normalised_state"])

    # What fills the plane up is not looked at, and every number before it is.
    model.head.kernel_share.fill_(0.6)
    other = seen.clone()
    other[:, 2].flatten(1)[:, LIMBS:] = 7.0
    assert torch.equal(model(other[None])["normalised_state"], before["normalised_state"])
    for number in range(LIMBS):
        other = seen.clone()
        other[at, 2].flatten()[number] += 5.0
        assert not torch.equal(model(other[None])["normalised_state"], before["normalised_state"])


@torch.no_grad()
def test_limbs_are_in_the_windows_means_of_them() -> None:
    model, seen = regressor(), frames_seen(20)
    context = model(seen[None])["visual_context"][0, :, model.context.network_output :].reshape(20, 3, 8 + LIMBS)
    weight = np.exp(-0.5 * ((np.arange(-4, 5)[None] - np.array([-2, 0, 2])[:, None]) / 0.5) ** 2)
    weight /= weight.sum(1, keepdims=True)
    limbs = seen[:, 2].flatten(1)[:, :LIMBS].numpy()
    for t in (0, 10, 19):
        near = limbs[np.clip(t + np.arange(-4, 5), 0, 19)]
        np.testing.assert_allclose(context[t, :, 8:], weight @ near, atol=1e-5)


@torch.no_grad()
def test_frame_by_frame_limbs_are_what_the_video_up_to_there_shows() -> None:
    model = regressor()
    assert_frame_by_frame_as_the_video_up_to_there(model, model.encode(frames_seen(17)))


# --- settings and names ----------------------------------------------------------------------------------------------


def test_a_regressor_sees_limbs_only_where_its_kernel_names_a_finder() -> None:
    assert body_part_estimator_name({}) is None
    assert body_part_estimator_name({"kernel": None}) is None
    assert body_part_estimator_name({"kernel": KERNEL}) is None, "regressors from before there were finders"
    assert from_mapping(KernelSettings, KERNEL, "x").limb_numbers == 0
    assert planes_of({"kernel": KERNEL}) == 2
    assert load_body_part_estimator_of({"kernel": KERNEL}) is None
    chosen = compose_config("train", ["regressor=blended"])["regressor"]
    assert (body_part_estimator_name(chosen), planes_of(chosen)) == ("body_parts", 3)
    finder = load_body_part_estimator("body_parts")
    assert load_body_part_estimator_of(chosen) is finder
    assert from_mapping(KernelSettings, chosen["kernel"], "x").limb_numbers == 2 * finder.numbers
    assert not finder.training
    for name in ("none-such", "people_estimation/..", ""):
        with pytest.raises(InputError, match="no body-part estimator"):
            load_body_part_estimator(name)


def test_the_regressors_name_tells_what_it_saw_limbs_with(monkeypatch: pytest.MonkeyPatch) -> None:
    config, store = compose_config("train", ["regressor=blended"]), SimpleNamespace(fingerprint="f")
    without = compose_config("train", ["regressor=blended", "regressor.kernel.body_parts=null"])
    names = [regressor_name(one, store, "flow") for one in (config, without)]
    monkeypatch.setattr(sight, "load_body_part_estimator", lambda _: finder_of_chance(seed=4))
    names += [regressor_name(one, store, "flow") for one in (config, without)]
    assert len(set(names)) == 3
    assert names[1] == names[3], "without limbs it is nobody's affair what the finder is"
    other = finder_of_chance(seed=4)
    other.posture.bias.data[0] += 1e-3
    before = body_part_fingerprint("body_parts")
    monkeypatch.setattr(sight, "load_body_part_estimator", lambda _: other)
    assert body_part_fingerprint("body_parts") != before


def test_a_live_forecast_needs_the_limbs_of_the_estimating_run(monkeypatch: pytest.MonkeyPatch) -> None:
    trained = untrained()
    run = run_config("fast", "residual")
    run["task"] = {**run["task"], "context": 30}
    run["model"] = {**run["model"], "context": {**run["model"]["context"], "source": "past"}}
    run["task"] = {**run["task"], "name": "forecasting"}
    monkeypatch.setattr(build, "find_checkpoint", lambda *_: Path("forecasts"))
    monkeypatch.setattr(build, "read_json", lambda *_: run)
    monkeypatch.setattr(build, "load_regressor", lambda _: (trained.regressor, trained.source_config))
    chosen = compose_config("stream", ["source=none", "checkpoint=none", "forecast.checkpoint=forecasts"])
    seeing = {
        **trained.source_config,
        "regressor": {**trained.source_config["regressor"], "kernel": {"body_parts": "body_parts"}},
    }
    with pytest.raises(InputError, match=r"regressor\.kernel\.body_parts"):
        load_forecaster(chosen, replace(trained, source_config=seeing))


# --- in a store ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("limbs")
    prepare(configuration(folder), progress=False, flow=False)
    fill_flow(configuration(folder))
    return folder


def test_a_store_keeps_the_finders_rows_and_its_regressor_is_read_back(
    folder: Path, finder: BodyPartEstimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = blended(folder)
    config["regressor"]["kernel"] = {**KERNEL, "body_parts": "body_parts"}
    store, humanoid, flow = TakeStore.open(folder / "store"), humanoid_of(config), flow_name(config)
    known = torch.randn(store.frames_total, 2 * finder.numbers).half()
    asked: list[Any] = []

    def rows_of(video: Path, seen: np.ndarray, *_: Any) -> np.ndarray:
        (take,) = (i for i in range(len(store.takes)) if store.video(i) == video)
        np.testing.assert_array_equal(seen, store.flow(flow)[store.frames(take)])
        asked.append(take)
        return known[store.frames(take)].numpy()

    for module in (sight, blending):
        monkeypatch.setattr(module, "load_body_part_estimator", lambda _: finder)
    monkeypatch.setattr("egopose.pipeline.regressor_input.extract_body_parts", rows_of)
    wanted = np.concatenate([store.flow(flow), as_plane(known.numpy(), 8)], axis=1)
    there = {path.name for path in (store.root / "tables").glob("*")}
    np.testing.assert_array_equal(seen_in_store(config, config["regressor"], store, flow)[:], wanted)
    assert {path.name for path in (store.root / "tables").glob("*")} == there, "nothing is kept unasked"
    assert seen_in_store(config, {"kernel": KERNEL}, store, flow)[:].shape[1] == 2

    # Flow and limbs of chance tell nothing: either share would be nought, and nothing of the kernel be compared.
    monkeypatch.setattr(blending, "choose_shares", lambda *_: (0.3, 0.6))
    tables, weights = regressor_tables(config, store, humanoid, flow)
    kept = sorted(path.name for path in (store.root / "tables").glob("body_parts-*"))
    assert len(kept) == 1
    assert store.table_card(kept[0]) == {"flow": flow, "finder": "body_parts"}
    asked.clear()
    np.testing.assert_array_equal(seen_in_store(config, config["regressor"], store, flow)[:], wanted)
    assert not asked, "the table is read"

    model, source_config = load_regressor(weights)
    assert planes_of(source_config["regressor"]) == 3
    assert model.encoder.limbs == 2 * finder.numbers
    monkeypatch.setattr(regression, "_is_trained", lambda *_: False)  # so that it predicts anew
    again, _ = kept_tables(config, store, humanoid, flow, weights)
    # Test frames alone: on training frames the table is cross-fitted.
    for take in store.takes:
        tail = slice(take.offset + round(take.length / 2), take.offset + take.length)
        torch.testing.assert_close(again["humanoid_state"][tail], tables["humanoid_state"][tail])

    monkeypatch.setattr(sight, "load_body_part_estimator", lambda _: finder_of_chance(seed=4))
    seen_in_store(config, config["regressor"], store, flow)
    assert asked == list(range(len(store.takes))), "other weights, other rows"
