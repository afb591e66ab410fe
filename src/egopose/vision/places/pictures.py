"""Pictures of ground, walls, fronts of buildings and the sky: drawn from a seed, with detail at every scale.

Grass and gravel are photographs (``assets/surfaces``), laid at several scales and turns so that no repeat shows.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array
from egopose.vision.surfaces import add_texture

Picture = NDArray[np.float32]

GROUNDS = ("grass", "gravel", "paving", "asphalt", "soil")
# Mean colours, and metres that the photographs show across: stones of 2 to 4 cm, blades of some 5 cm.
_COLOURS = {
    "grass": (95, 115, 60),
    "gravel": (140, 135, 128),
    "paving": (150, 145, 138),
    "asphalt": (88, 88, 92),
    "soil": (120, 95, 70),
}
_ACROSS = {"grass": 1.2, "gravel": 0.7}
# A photograph shrunk to fewer pixels than these shows nothing any more.
_SMALLEST = 32


@cache
def _photo(name: str) -> Picture:
    """A photograph ``[N, N]`` of mean 0 and deviation 1, without the shades by which a repeat would be seen."""
    raw = np.frombuffer((files("egopose") / "assets" / "surfaces" / f"{name}.jpg").read_bytes(), np.uint8)
    grey = cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    wide = grey.astype(np.float32)
    detail = wide - cv2.GaussianBlur(wide, (0, 0), 60.0)
    return np.asarray(detail / detail.std(), np.float32)


def octaves(rng: np.random.Generator, size: int, first: int, last: int, power: float = 0.3) -> Picture:
    """Noise ``[size, size]`` of mean 0 and deviation 1: ``first`` to ``last`` cells across, weighted cells^-power."""
    total, cells = np.zeros((first, first), np.float32), first
    while True:
        total = total + cells**-power * rng.normal(size=(cells, cells)).astype(np.float32)
        # Octave by octave, so that coarse noise is not enlarged to all of the pixels each time.
        cells = min(2 * cells, size)
        total = np.asarray(cv2.resize(total, (cells, cells), interpolation=cv2.INTER_CUBIC), np.float32)
        if cells > last or cells == size:
            break
    if cells < size:
        total = np.asarray(cv2.resize(total, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)
    return np.asarray((total - total.mean()) / total.std(), np.float32)


def _laid(name: str, rng: np.random.Generator, size: int, metres: float) -> Picture:
    """A photograph laid over the ground twice, at two scales and turns, blended by noise; 0 where it is too small."""
    total = np.zeros((size, size), np.float32)
    mask = 1 / (1 + np.exp(-4 * octaves(rng, size, 4, 16)))
    for share, turns in ((mask, 0), (1 - mask, int(rng.integers(1, 4)))):
        side = round(size * _ACROSS[name] * rng.uniform(0.8, 1.6) / metres)
        if side < _SMALLEST:
            continue
        photo = cv2.resize(np.rot90(_photo(name), turns), (side, side), interpolation=cv2.INTER_AREA)
        # Mirrored, so that edges meet.
        tile = np.block([[photo, photo[:, ::-1]], [photo[::-1], photo[::-1, ::-1]]])
        count = size // tile.shape[0] + 2
        at = rng.integers(0, tile.shape[0], 2)
        total += share * np.tile(tile, (count, count))[at[0] : at[0] + size, at[1] : at[1] + size]
    return total


def _slabs(rng: np.random.Generator, size: int, metres: float) -> Picture:
    """Slabs of 25 to 60 cm in rows, each of its own shade, with dark joints."""
    pixel = size / metres
    wide, deep = rng.uniform(0.25, 0.6) * pixel, rng.uniform(0.25, 0.4) * pixel
    v, u = np.mgrid[0:size, 0:size].astype(np.float32)
    row = np.floor(v / deep)
    shifted = u / wide + 0.5 * (row % 2) * (rng.random() < 0.7)
    column = np.floor(shifted)
    shades = rng.normal(size=(64, 64)).astype(np.float32)
    slab = shades[row.astype(int) % 64, column.astype(int) % 64]
    joint = np.minimum((v / deep - row) * deep, (shifted - column) * wide) < max(0.012 * pixel, 1.0)
    return np.asarray(0.7 * slab - 2.5 * joint, np.float32)


def ground_picture(rng: np.random.Generator, kind: str, size: int, metres: float) -> NDArray[np.uint8]:
    """Ground of a kind of :data:`GROUNDS` seen from above.

    Args:
        rng: what it is drawn with.
        kind: of the ground.
        size: pixels a side.
        metres: that the picture covers.

    Returns:
        ``[size, size, 3]`` RGB.
    """
    # Down to pixels, or to 2 cm where pixels are finer.
    finest = int(min(size, metres / 0.02))
    fine = octaves(rng, size, max(finest // 8, 2), finest, 0.0)
    # Every octave alike: seen at a slant and from afar, decimetres and metres are all that flow can grip.
    broad = octaves(rng, size, 2, max(finest // 4, 4), 0.0)
    if kind in _ACROSS:
        detail, strength = _laid(kind, rng, size, metres), 0.30
        detail = detail if detail.any() else fine
    elif kind == "paving":
        detail, strength = _slabs(rng, size, metres) + 0.4 * fine, 0.16
    else:
        # Patches and cracks: where noise crosses a level.
        mended = octaves(rng, size, 3, 24, 0.5) > 1.2
        cracks = np.abs(octaves(rng, size, 4, 128, 0.6)) < 0.03
        detail, strength = fine - 1.0 * mended - 1.5 * cracks, 0.16 if kind == "asphalt" else 0.22
    colour = np.array(_COLOURS[kind]) * rng.uniform(0.8, 1.2) + rng.normal(scale=6.0, size=3)
    # Hues change slowly over the ground.
    tinted = colour + 5.0 * np.stack([octaves(rng, 64, 2, 16) for _ in range(3)], axis=-1)
    wide = cv2.resize(tinted.astype(np.float32), (size, size), interpolation=cv2.INTER_LINEAR)
    light = np.asarray(1 + strength * detail + 0.2 * broad, np.float32)
    return np.clip(wide * light[..., None], 0, 255).astype(np.uint8)


def wall_picture(rng: np.random.Generator, size: int) -> NDArray[np.uint8]:
    """An inner wall ``[size, size, 3]``: plaster with faint marks, sometimes wallpaper."""
    base = np.array([200.0, 195.0, 185.0]) * rng.uniform(0.6, 1.1) + rng.normal(scale=15.0, size=3)
    shade = rng.uniform(4.0, 14.0) * octaves(rng, size, 2, size // 2)
    if rng.random() < 0.5:
        v, u = np.mgrid[0:size, 0:size] / size
        period = rng.uniform(0.03, 0.12)
        paper = np.sin(2 * np.pi * u / period) * (1.0 if rng.random() < 0.5 else np.sin(2 * np.pi * v / period))
        shade = shade + rng.uniform(6.0, 25.0) * np.sign(paper)
    return np.clip(base + shade[..., None], 0, 255).astype(np.uint8)


def front_picture(rng: np.random.Generator, width: float, height: float, pixel: float = 0.03) -> NDArray[np.uint8]:
    """The front of a building with windows and a door, ``pixel`` m a pixel; its first row is the top.

    Args:
        rng: what it is drawn with.
        width, height: m.
        pixel: m.
    """
    columns, rows = (min(max(round(side / pixel), 16), 1024) for side in (width, height))
    side = max(columns, rows)
    shade = 10.0 * octaves(rng, side, 4, side // 2)[:rows, :columns]
    v, u = np.mgrid[0:rows, 0:columns] * (height / rows, width / columns)[0]
    if rng.random() < 0.6:
        # Bricks of 24 by 7 cm; further than some metres only their shades are seen.
        row = np.floor(v / 0.075)
        shade = (
            shade + 9.0 * rng.normal(size=(97, 89))[row.astype(int) % 97, np.floor(u / 0.25 + row / 2).astype(int) % 89]
        )
    colour = rng.uniform([110, 80, 70], [215, 200, 190])
    picture = np.asarray(colour + shade[..., None], np.float32)
    storey, bay = rng.uniform(2.8, 3.4), rng.uniform(1.8, 3.2)
    window, frame = rng.uniform([0.8, 1.2], [1.3, 1.9]), rng.uniform(150, 245)
    for floor in np.arange(0.0, height - storey, storey):
        for left in np.arange(0.5 * (width % bay), width - bay + 0.01, bay):
            x = int((left + 0.5 * (bay - window[0])) / width * columns)
            bottom = height - floor - (0.0 if floor == 0 and rng.random() < 0.3 else 0.9)
            y0, y1 = int((bottom - window[1]) / height * rows), int(bottom / height * rows)
            x1 = x + max(int(window[0] / width * columns), 2)
            picture[max(y0 - 2, 0) : y1 + 2, max(x - 2, 0) : x1 + 2] = frame
            glass = picture[max(y0, 0) : y1, x:x1]
            glass[:] = rng.uniform(20, 110) + rng.normal(scale=12.0, size=(1, 1, 3))
            picture[max(y0, 0) : y1, (x + x1) // 2] = frame
    return np.clip(picture, 0, 255).astype(np.uint8)


def add_sky(spec: mujoco.MjSpec, rng: np.random.Generator, size: int = 256) -> None:
    """A sky with clouds above, haze at the horizon and below it, infinitely far away."""
    zenith, horizon = np.array([80.0, 130.0, 200.0]), np.array([200.0, 210.0, 220.0])
    clouds, cover = octaves(rng, 512, 4, 128, 0.8), rng.uniform(-0.5, 1.2)
    middle = 2 * (np.arange(size) + 0.5) / size - 1
    c, r = np.meshgrid(middle, -middle)
    one = np.ones_like(c)
    # How MuJoCo lays a sky's six faces; each side's first column is on the right of who looks at it.
    faces = [(one, c, r), (-one, -c, r), (c, r, one), (c, -r, -one), (c, -one, r), (-c, one, r)]
    pictures = [_sky_face(np.stack(face, axis=-1), zenith, horizon, clouds, cover) for face in faces]
    add_texture(spec, "place_sky", mujoco.mjtTexture.mjTEXTURE_SKYBOX, np.concatenate(pictures))


def _sky_face(direction: Array, zenith: Array, horizon: Array, clouds: Picture, cover: float) -> NDArray[np.uint8]:
    up = direction[..., 2] / np.linalg.norm(direction, axis=-1)
    share = np.clip(up, 0.0, 1.0)[..., None] ** 0.5
    sky = horizon * (1 - share) + zenith * share
    # Clouds lie on a plane overhead.
    plane = direction[..., :2] / np.maximum(direction[..., 2:] + 0.12, 0.12)
    at = ((0.06 * plane + 0.5) * clouds.shape[0]).astype(int) % clouds.shape[0]
    density = np.clip(clouds[at[..., 0], at[..., 1]] - cover, 0.0, 1.0) * (up > 0)
    return np.clip(sky + density[..., None] * (240.0 - sky), 0, 255).astype(np.uint8)
