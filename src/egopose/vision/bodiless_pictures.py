"""Pictures in which no limb of the wearer is seen, as a worn camera takes them: what is found in them is false."""

from __future__ import annotations

from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array
from egopose.vision.film import small_picture
from egopose.vision.flow import FlowEstimator, grey_square
from egopose.vision.places.place import Way
from egopose.vision.places.plain_room import draw_plain_room
from egopose.vision.places.scenery import FILM_CAMERA, PLACES, draw_scenery, scenery_model, scenery_of
from egopose.vision.rendering import SceneRenderer
from egopose.vision.takes import RenderConfig

#: The kinds: the rooms that takes are rendered in, then places of other sorts.
KINDS = ("plain_room", *PLACES)
_PAIRS = 12  # a place
# A walk: steps at 30 Hz, m and rad each; m of the camera above the floor; rad of its play between two frames.
_STEPS, _STRIDE, _TURN, _HEIGHT, _PLAY = 60, 0.045, 0.03, (1.45, 1.75), 0.01
_JPEG = (40, 95)  # quality: what video compression leaves, as in conf/body_parts.yaml


def bodiless_pictures(
    kind: str, seed: int, count: int, render: RenderConfig, flow: FlowEstimator
) -> tuple[NDArray[np.uint8], NDArray[np.float16]]:
    """Pairs of pictures of places of a kind, always the same for a seed.

    Args:
        kind: of :data:`KINDS`.
        seed: of places and cameras.
        count: N, at least 1.
        render: rooms, and how cameras are worn.
        flow: between the two.

    Returns:
        ``[N, 6, 64, 64]`` RGB of the earlier picture, then of the later, and flow ``[N, 2, S, S]``, as the body-part
        estimator reads them.

    Raises:
        InputError: an unknown kind.
        RuntimeError: no OpenGL here.
    """
    rng = np.random.default_rng([seed, 61])
    pictures: list[NDArray[np.uint8]] = []
    flows: list[NDArray[np.float16]] = []
    while len(pictures) < count:
        own = int(rng.integers(1 << 30))
        heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(scale=_TURN, size=_STEPS))
        path = np.cumsum(_STRIDE * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
        way = Way(path, heading, _HEIGHT[1])
        plain = kind == "plain_room"
        scenery = (
            scenery_of(draw_plain_room(own, way, render.room), own, way) if plain else draw_scenery(kind, own, way)
        )
        with SceneRenderer(scenery_model(scenery), render.size, render.size) as renderer:
            camera = renderer.model.camera(FILM_CAMERA).id
            renderer.model.cam_fovy[camera] = rng.uniform(*render.camera.field_of_view)
            height = rng.uniform(*_HEIGHT)
            for _ in range(min(_PAIRS, count - len(pictures))):
                later, pitch = int(rng.integers(1, _STEPS)), np.deg2rad(rng.uniform(*render.camera.pitch_down))
                pair = []
                for step in (later - 1, later):
                    yaw, down, roll = np.array([heading[step], pitch, 0.0]) + rng.normal(scale=_PLAY, size=3)
                    renderer.model.cam_pos[camera] = [*path[step], height]
                    renderer.model.cam_quat[camera] = _looking(yaw, down, roll)
                    pair.append(_packed(renderer.render(renderer.data.qpos.copy(), FILM_CAMERA), rng))
                pictures.append(np.concatenate([small_picture(one) for one in pair], axis=2).transpose(2, 0, 1))
                flows.append(flow(*(grey_square(one, flow.config.working_size) for one in pair)))
    return np.stack(pictures), np.stack(flows)


def _looking(yaw: float, down: float, roll: float) -> Array:
    """The quaternion of a MuJoCo camera (x right, y up, z back) that looks along ``yaw``, down and rolled (rad)."""
    level = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    ahead = np.cos(down) * level - np.sin(down) * np.array([0.0, 0.0, 1.0])
    right = np.array([level[1], -level[0], 0.0])
    up = np.cross(right, ahead)
    axes = np.stack(
        [np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right, -ahead], axis=1
    )
    out = np.empty(4)
    mujoco.mju_mat2Quat(out, axes.ravel())
    return out


def _packed(frame: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[Any]:
    """The RGB frame as it comes out of a JPEG."""
    _, data = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*_JPEG))])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)[..., ::-1]
