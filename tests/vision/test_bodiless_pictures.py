"""Pictures without a body: always the same for a seed, of many places, and nothing of the wearer in them."""

from __future__ import annotations

import numpy as np
import pytest

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.vision.bodiless_pictures import KINDS, bodiless_pictures
from egopose.vision.flow import FlowConfig, FlowEstimator
from egopose.vision.gl import choose_backend
from egopose.vision.takes import RenderConfig


@pytest.fixture(scope="module")
def render() -> RenderConfig:
    try:
        choose_backend()
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    return RenderConfig.from_mapping(compose_config("train", ["vision.room.texture_size=64"])["vision"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_gives_its_pictures_again(kind: str, render: RenderConfig) -> None:
    flow = FlowEstimator(FlowConfig("ultrafast", 128, 32, 1))
    pictures, moved = bodiless_pictures(kind, 3, 13, render, flow)
    assert (pictures.shape, pictures.dtype) == ((13, 6, 64, 64), np.uint8)
    assert (moved.shape, moved.dtype) == ((13, 2, 32, 32), np.float16)
    first, _ = bodiless_pictures(kind, 3, 2, render, flow)
    np.testing.assert_array_equal(first, pictures[:2])
    # The 13th is of a second place; the camera moves a little from one picture of a pair to the next.
    means = pictures.astype(float).mean((2, 3))
    assert len(np.unique(means[:, 0])) == 13
    assert 0 < np.abs(moved.astype(float)).mean() < 0.1
    before, now = pictures[:, :3].astype(float), pictures[:, 3:].astype(float)
    assert np.abs(before - now).mean() < np.abs(before[1:] - now[:-1]).mean()


def test_an_unknown_kind_is_told(render: RenderConfig) -> None:
    with pytest.raises(InputError, match="attic"):
        bodiless_pictures("attic", 0, 1, render, FlowEstimator(FlowConfig("ultrafast", 128, 32, 1)))
