"""Training of a limb finder: that it learns, goes on as if never stopped, says truly how well it does, and is kept."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import egopose
from egopose.checkpoint.checkpoint import RunCheckpoint, read_json
from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.data.preparation import humanoid_of
from egopose.motion.skeleton import Skeleton
from egopose.pipeline import body_parts
from egopose.training import body_parts as limb_finder
from egopose.training.body_parts import (
    BodyPartSettings,
    BodyPartTraining,
    Pictures,
    bodiless_figures,
    held_out_figures,
    posture_mirror,
    save_body_part_estimator,
    train_body_part_estimator,
    varied,
)
from egopose.vision.bodiless_pictures import KINDS
from egopose.vision.body_part_pictures import posture_names
from egopose.vision.body_parts import LIMBS, BodyPartEstimator
from egopose.vision.flow import FlowConfig

WALK = Path(egopose.__file__).parent / "assets" / "clips" / "deepmimic_walk.motion.npz"
SMALL = ["training.channels=8", "training.batch=4", "training.threads=1", "training.bfloat16=false"]


@pytest.fixture(scope="module")
def config() -> dict[str, Any]:
    return compose_config("body_parts", [f"motions=['{WALK}']", "out=x", *SMALL])


@pytest.fixture(scope="module")
def skeleton(config: dict[str, Any]) -> Skeleton:
    return humanoid_of(config).skeleton


@pytest.fixture(scope="module")
def settings(config: dict[str, Any]) -> BodyPartSettings:
    return BodyPartSettings.from_config(config["training"])


@pytest.fixture(scope="module")
def data() -> Pictures:
    """A bright square where the left arm is; all of the posture follows from how far down it is."""
    generator = torch.Generator().manual_seed(0)
    pictures = torch.randint(0, 60, (48, 6, 64, 64), generator=generator, dtype=torch.uint8)
    masks, posture = torch.zeros(48, 5, 32, 32, dtype=torch.uint8), torch.zeros(48, 89)
    for k in range(48):
        row, column = torch.randint(0, 24, (2,), generator=generator).tolist()
        pictures[k, :, 2 * row : 2 * row + 16, 2 * column : 2 * column + 16] = 220
        masks[k, 1, row : row + 8, column : column + 8] = 255
        posture[k] = torch.linspace(-1, 1, 89) * (row - 12) / 12
    return Pictures(pictures, torch.zeros(48, 2, 32, 32, dtype=torch.float16), masks, posture)


def test_a_short_training_lowers_the_loss(data: Pictures, skeleton: Skeleton, settings: BodyPartSettings) -> None:
    work = BodyPartTraining(
        data, skeleton, replace(settings, epochs=15, batch=16, warm_up=3, learning_rate=0.01), seed=1
    )
    losses = [work.step() for _ in range(work.total_steps)]
    assert len(losses) == 45
    assert sum(losses[-3:]) < 0.6 * sum(losses[:3])


def test_resumed_training_equals_one_that_was_never_stopped(
    data: Pictures, skeleton: Skeleton, settings: BodyPartSettings, tmp_path: Path
) -> None:
    few = replace(settings, epochs=1.5, save_every=5)
    whole = train_body_part_estimator(data, skeleton, few, seed=2)

    def stop(steps: int, total: int, loss: float) -> None:
        if steps == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_body_part_estimator(data, skeleton, few, 2, tmp_path / "training", stop)
    told: list[int] = []
    parted = train_body_part_estimator(
        data, skeleton, few, 2, tmp_path / "training", lambda steps, total, loss: told.append(steps)
    )
    assert told == [15, 18]
    for key, value in whole.state_dict().items():
        torch.testing.assert_close(parted.state_dict()[key], value, rtol=0, atol=0)
    other = train_body_part_estimator(data, skeleton, few, seed=3)
    assert not torch.equal(other.posture.weight, whole.posture.weight)
    with pytest.raises(InputError, match="training: settings: are another training's"):
        train_body_part_estimator(data, skeleton, replace(few, channels=16), 2, tmp_path / "training")


def test_every_picture_comes_once_an_epoch(data: Pictures, skeleton: Skeleton, settings: BodyPartSettings) -> None:
    work = BodyPartTraining(data, skeleton, replace(settings, batch=16), seed=1)
    seen = []
    for step in range(6):
        work.steps = step
        seen.append(work._batch())
    assert sorted(torch.cat(seen[:3]).tolist()) == sorted(torch.cat(seen[3:]).tolist()) == list(range(48))
    assert not torch.equal(torch.cat(seen[:3]), torch.cat(seen[3:]))


def test_variants_keep_flow_masks_and_posture_of_one_side(
    data: Pictures, skeleton: Skeleton, settings: BodyPartSettings
) -> None:
    mirror, generator = posture_mirror(skeleton), torch.Generator().manual_seed(4)
    sample = varied(data, mirror, replace(settings, gain=0.0, offset=0.0), generator)
    flipped = sample.masks[:, 0].amax((1, 2)) > 0
    assert 5 < flipped.sum() < 43
    torch.testing.assert_close(sample.posture[~flipped], data.posture[~flipped])
    torch.testing.assert_close(sample.posture[flipped], mirror.state(data.posture[flipped]))
    bright = sample.pictures[:, 0, ::2, ::2] > 200
    torch.testing.assert_close(bright, sample.masks.amax(1) == 255)


def test_figures_are_one_for_the_truth_and_nought_for_the_mean(
    data: Pictures, skeleton: Skeleton, settings: BodyPartSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = BodyPartTraining(data, skeleton, settings, seed=1).model
    at = iter(range(0, 48, 16))

    def truth(before: torch.Tensor, now: torch.Tensor, flow: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rows = slice(first := next(at), first + 16)
        posture = (data.posture[rows] - model.mean) / model.std
        return (data.masks[rows].float() - 127.5), posture, torch.zeros(16, 89)

    monkeypatch.setattr(model, "forward", truth)
    figures = held_out_figures(model, data, skeleton, 16)
    assert figures["masks"] == dict(zip(LIMBS, [0.0, 1.0, 0.0, 0.0, 0.0], strict=True))
    assert figures["posture"]["RightHand"] == figures["posture"]["camera height"] == 1.0
    assert set(figures["joints"]) == {name.rpartition("_")[0] for name in posture_names(skeleton)[37:]}
    monkeypatch.setattr(
        model, "forward", lambda *_: (torch.zeros(16, 5, 32, 32), torch.zeros(16, 89), torch.zeros(16, 89))
    )
    assert held_out_figures(model, data, skeleton, 16)["posture"]["up"] == pytest.approx(0.0, abs=1e-4)


def test_a_finder_is_kept_without_pickle_and_comes_back(
    data: Pictures, skeleton: Skeleton, settings: BodyPartSettings, tmp_path: Path
) -> None:
    model = BodyPartTraining(data, skeleton, settings, seed=1).model.eval()
    folder = save_body_part_estimator(
        tmp_path / "finder", model, skeleton, FlowConfig("fast", 64, 32), {"samples": 48}, 1
    )
    source_config = read_json(folder, "config")
    again = BodyPartEstimator(source_config["numbers"], source_config["channels"])
    RunCheckpoint({"finder": again}).restore(folder)
    seen = data.pictures[:2, :3], data.pictures[:2, 3:], data.flow[:2]
    for mine, theirs in zip(model(*seen), again.eval()(*seen), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=0)
    assert source_config["flow"] == {"preset": "fast", "working_size": 64, "stored_size": 32, "workers": 2}
    assert read_json(folder, "card") == {"samples": 48}
    assert {path.suffix for path in folder.rglob("*") if path.is_file()} == {".json", ".memmap"}


def test_the_verb_draws_trains_keeps_and_does_nothing_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = ["pictures.samples=24", "pictures.rooms_a_part=1", "pictures.wearings=2", "pictures.pairs=6", "workers=1"]
    tiny += ["bodiless=2", "vision.room.texture_size=64", "training.held_out=0.25", "training.epochs=1"]
    values = compose_config("body_parts", [f"motions=['{WALK}']", f"out={tmp_path / 'out'}", *SMALL, *tiny])
    card = body_parts.make_body_part_estimator(values)
    assert (card["samples"], card["held_out"]) == (24, 6)
    assert list(card["motions"]) == [WALK.name]
    assert set(card["figures"]["masks"]) == set(LIMBS)
    assert set(card["without a body"]) == set(KINDS)
    assert read_json(tmp_path / "out" / "finder", "card") == json.loads(json.dumps(card))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["finder", "pictures"]
    monkeypatch.setattr(limb_finder, "train_body_part_estimator", lambda *_: pytest.fail("it is trained already"))
    assert body_parts.make_body_part_estimator(values) == json.loads(json.dumps(card))
    values["training"]["epochs"] = 2
    with pytest.raises(InputError, match="finder of other settings"):
        body_parts.make_body_part_estimator(values)


def test_what_is_found_without_a_body_is_counted_as_false(
    data: Pictures, skeleton: Skeleton, settings: BodyPartSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = BodyPartTraining(data, skeleton, settings, seed=1).model

    def seen(before: torch.Tensor, now: torch.Tensor, flow: torch.Tensor) -> tuple[torch.Tensor, ...]:
        masks = torch.full((len(now), 5, 32, 32), -9.0)
        masks[:, 1, :16], masks[:, 4, 8:24] = 9.0, 9.0  # half of the picture each, a quarter in common
        return masks, torch.zeros(len(now), 89), torch.log(torch.full((len(now), 89), 0.25))

    monkeypatch.setattr(model, "forward", seen)
    figures = bodiless_figures(model, data.pictures[:7], data.flow[:7], batch=3)
    wanted = {"false": 0.75, **dict.fromkeys(LIMBS, 0.0), "left arm": 0.5, "trunk": 0.5, "variance": 0.25}
    assert figures == pytest.approx(wanted)


def test_settings_that_cannot_be_are_told(
    config: dict[str, Any], data: Pictures, skeleton: Skeleton, settings: BodyPartSettings
) -> None:
    for name, value in (("batch", 0), ("channels", 12), ("epochs", 0), ("held_out", 1.0)):
        with pytest.raises(InputError, match=f"training: {name}: must"):
            BodyPartSettings.from_config({**config["training"], name: value})
    with pytest.raises(InputError, match="bodiless: must be at least 1"):
        body_parts.make_body_part_estimator({**config, "bodiless": 0})
    with pytest.raises(InputError, match="batch: is 64, and there are 48"):
        BodyPartTraining(data, skeleton, replace(settings, batch=64), 1)
