"""The side-by-side picture: panels, order, and the square cut from any video."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from egopose.vision.side_by_side import middle_square, side_by_side

XML = """<mujoco><worldbody><geom type="plane" size="5 5 1" rgba=".2 .2 .8 1"/><light pos="0 0 4"/>
<body name="Hips" pos="0 0 1"><freejoint/><geom size=".3" rgba="1 0 0 1"/></body></worldbody></mujoco>"""


def test_panels_stand_in_order_and_end_with_the_shortest() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    near, gone = np.tile([0, 0, 0.9, 1, 0, 0, 0.0], (4, 1)), np.tile([0, 0, -9, 1, 0, 0, 0.0], (5, 1))
    green = np.zeros((30, 60, 3), np.uint8)
    green[..., 1] = 200
    try:
        frames = list(side_by_side(model, {"reference": near, "estimate": gone}, [green] * 3, "rendered", 96))
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    assert [f.shape for f in frames] == [(96, 288, 3)] * 3
    reference, estimate, wearer = (frames[0][30:66, a + 30 : a + 66].astype(int) for a in (0, 96, 192))
    red = [(p[..., 0] > 1.5 * p[..., 2]).mean() for p in (reference, estimate)]
    assert red[0] > 0.15
    assert red[1] < 0.05
    assert (wearer[..., 1] > 150).all()


@pytest.mark.parametrize("shape", [(20, 40, 3), (40, 20, 3), (20, 20, 3)])
def test_the_middle_square_keeps_the_middle(shape: tuple[int, int, int]) -> None:
    picture = np.zeros(shape, np.uint8)
    picture[shape[0] // 2 - 2 : shape[0] // 2 + 2, shape[1] // 2 - 2 : shape[1] // 2 + 2] = 255
    square = middle_square(picture, 10)
    assert square.shape == (10, 10, 3)
    assert square[5, 5].min() == 255
    assert square[0].max() == 0
