"""Films that no walking wearer took: from a drone, from a tripod, and before a large moving picture.

A method that estimates a wearer's motion is to doubt itself on them.
"""

from __future__ import annotations

from os import PathLike

import numpy as np

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.vision.camera_tracks import Poses, free_track
from egopose.vision.places.moving_picture import draw_moving_picture
from egopose.vision.places.open_ground import draw_open_ground
from egopose.vision.places.place import Way
from egopose.vision.places.scenery import draw_scenery, scenery_model, scenery_of
from egopose.vision.virtual_gopro import FilmSettings, FilmTruth, film_scene, film_worn

# m: a drone's lowest and highest flight, and how deep a cliff is; m/s and rad/s of its flight.
_LOWEST, _HIGHEST, _DROP = 5.0, 60.0, 40.0
_SPEED, _TURNING = (3.0, 10.0), 0.25
# s of the slowest and fastest changes of a drone's flight.
_SLOW, _FAST = 12.0, 3.0
_TRIPOD = (1.3, 1.6)
_SAMPLES = 50.0


def drone_film(path: str | PathLike[str], settings: FilmSettings, duration: float, cliff: bool = False) -> FilmTruth:
    """A camera that flies smoothly 5 to 60 m over open ground, or along the edge of a cliff.

    Args:
        path: the MP4.
        settings: of the camera; mount and place are not asked.
        duration: s.
        cliff: fly along the edge of a plateau.

    Raises:
        InputError: a setting that cannot be, or no place to write to.
        RuntimeError: no OpenGL here.
    """
    _check(duration)
    rng = np.random.default_rng([settings.seed, 12])
    times = np.arange(int(np.ceil(duration * _SAMPLES)) + 2) / _SAMPLES
    speed = rng.uniform(*_SPEED)
    wander = _waves(rng, times)
    heading = rng.uniform(-np.pi, np.pi) + _TURNING * _SLOW / 2 * wander[0]
    if cliff:
        # Along the edge, which runs along x.
        heading = 0.4 * wander[0]
    velocity = speed * (1 + 0.3 * wander[1])[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    ground = np.cumsum(velocity, axis=0) / _SAMPLES
    middle, half = np.exp(rng.uniform(np.log(_LOWEST), np.log(_HIGHEST))), rng.uniform(0.5, 4.0)
    height = np.clip(middle + half * wander[2], _LOWEST, _HIGHEST)
    yaw = heading + rng.uniform(-0.5, 0.5) + 0.2 * wander[3]
    pitch = np.deg2rad(settings.pitch_down) + 0.08 * wander[4]
    # It banks into its turns.
    roll = np.clip(0.1 * speed * np.gradient(heading, times), -0.4, 0.4) + 0.02 * wander[5]
    track = free_track(times, np.column_stack([ground, height]), _looking(yaw, pitch, roll))
    way = Way(ground, heading, _HIGHEST)
    place = draw_open_ground(settings.seed, way, _DROP if cliff else 0.0)
    return film_scene(scenery_of(place, settings.seed, way, settings.people), path, settings, track, duration)


def still_film(path: str | PathLike[str], settings: FilmSettings, duration: float) -> FilmTruth:
    """A camera on a tripod in the settings' place, where people pass.

    Args and Raises as :func:`drone_film`; nothing moves but the people.
    """
    _check(duration)
    rng = np.random.default_rng([settings.seed, 13])
    way = Way(np.zeros((1, 2)), np.array([rng.uniform(-np.pi, np.pi)]), _TRIPOD[1])
    scenery = draw_scenery(settings.place, settings.seed, way, people=True, table=settings.table)
    place = np.array([0.0, 0.0, rng.uniform(*_TRIPOD)])
    turn = _looking(way.heading, np.deg2rad([settings.pitch_down]), np.deg2rad([settings.roll]))

    def track(times: Array) -> tuple[Array, Array]:
        return np.tile(place, (len(times), 1)), np.tile(turn, (len(times), 1, 1))

    return film_scene(scenery, path, settings, track, duration)


def moving_picture_film(
    model_xml: str, qpos: Array, motion_fps: float, path: str | PathLike[str], settings: FilmSettings
) -> FilmTruth:
    """A wearer who stands before a window through which the world goes by; it fills most of the view.

    Args and Raises as :func:`egopose.vision.virtual_gopro.film`; the settings' place is not asked.
    """
    poses, way = Poses(qpos, motion_fps), Way.of(qpos)
    place = draw_moving_picture(settings.seed, way, poses.duration)
    model = scenery_model(scenery_of(place, settings.seed, way), model_xml)
    return film_worn(model_xml, poses, path, settings, model, place.far, place.move)


def _check(duration: float) -> None:
    if not 0.1 <= duration <= 3600.0:
        raise InputError("film", "duration", f"{duration} s; 0.1 to 3600")


def _waves(rng: np.random.Generator, times: Array) -> Array:
    """Six smooth signals ``[6, N]`` of about unit size: sums of slow sines."""
    periods = np.exp(rng.uniform(np.log(_FAST), np.log(_SLOW), (6, 4)))
    phases = rng.uniform(0, 2 * np.pi, (6, 4))
    # Faster ones are smaller.
    sizes = periods / periods.sum(axis=1, keepdims=True)
    return np.asarray(
        (sizes[..., None] * np.sin(2 * np.pi * times / periods[..., None] + phases[..., None])).sum(axis=1)
    )


def _looking(yaw: Array, pitch_down: Array, roll: Array) -> Array:
    """Rotations ``[N, 3, 3]`` from camera axes to the world of a camera that looks along ``yaw``, down and rolled."""
    c, s = np.cos(yaw), np.sin(yaw)
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    right, up = np.stack([s, -c, zero], axis=-1), np.stack([zero, zero, one], axis=-1)
    level = np.stack([c, s, zero], axis=-1)
    ahead = np.cos(pitch_down)[:, None] * level - np.sin(pitch_down)[:, None] * up
    down = -np.sin(pitch_down)[:, None] * level - np.cos(pitch_down)[:, None] * up
    cr, sr = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([cr * right + sr * down, cr * down - sr * right, ahead], axis=-1)
