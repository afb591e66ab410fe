"""BlazePose's two networks: one finds people, the other reads one person's keypoints (Bazarevsky et al. 2020).

The files are MediaPipe 0.10.14's ``pose_detection`` and ``pose_landmark_full`` (Apache-2.0). LiteRT runs them. What
stands around them follows MediaPipe's published graphs: anchors, regions, and the refinement by heat maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import cv2
import numpy as np

from egopose.core.errors import InputError
from egopose.motion.rotations import Array
from egopose.vision.video import Frame

KEYPOINTS = 33
#: Rows behind the keypoints: the middle of the hips, and a point on the circle around the whole body.
_CENTRE, _CIRCLE = 33, 34
_DETECTOR_SIDE, _SIDE, _HEAT = 224, 256, 64
#: Cells of the detector: stride (px) and boxes a cell, see ``pose_detection_cpu.pbtxt``.
_LAYERS = ((8, 2), (16, 2), (32, 6))
#: A region's side over the circle's diameter, ``pose_detection_to_roi.pbtxt``.
_ROOM = 1.25
_KERNEL, _LEAST_HEAT = 7, 0.5
_MOST_PEOPLE = 6
#: Boxes that share more than this of their union are of one person.
_SAME = 0.3


@dataclass(frozen=True)
class Region:
    """A square around a person: its middle (px), side (px), and turn (rad) clockwise in the picture."""

    x: float
    y: float
    side: float
    turn: float
    score: float = 1.0

    def matrix(self, side: int) -> Array:
        """``[2, 3]`` from the square's own pixels, ``side`` of them, to the picture's."""
        scale = self.side / side
        c, s = scale * np.cos(self.turn), scale * np.sin(self.turn)
        linear = np.array([[c, -s], [s, c]])
        return np.column_stack([linear, np.array([self.x, self.y]) - linear @ np.full(2, 0.5 * side)])


@dataclass(frozen=True)
class Reading:
    """What the second network read in a region.

    Args:
        pixels: ``[33, 2]`` px in the whole picture.
        confidence: ``[33]`` from 0 to 1: that a keypoint lies in the picture and is visible.
        positions: ``[33, 3]`` m, camera axes, relative to the middle of the hips.
        score: from 0 to 1: that there is a person in the region.
        region: where the person is to be looked for next.
    """

    pixels: Array
    confidence: Array
    positions: Array
    score: float
    region: Region


class BlazePoseNetworks:
    """The two networks, loaded.

    Args:
        threads: of the processor, for each network.

    Raises:
        InputError: LiteRT is not installed.
    """

    def __init__(self, threads: int = 1) -> None:
        try:
            from ai_edge_litert.interpreter import Interpreter
        except ImportError:
            cause = "needs ai-edge-litert: pip install 'egopose[poses]'"
            raise InputError("poses", "estimator=blazepose", cause) from None
        folder = files("egopose") / "weights" / "blazepose"

        def loaded(name: str) -> Any:
            network = Interpreter(model_content=(folder / name).read_bytes(), num_threads=threads)
            network.allocate_tensors()
            return network

        self._detector, self._reader = loaded("pose_detection.tflite"), loaded("pose_landmark_full.tflite")
        self._anchors = _anchors()

    def people(self, frame: Frame, least: float = 0.5) -> list[Region]:
        """Regions of people in a picture ``[H, W, 3]``, the surest first, overlapping ones once."""
        height, width = frame.shape[:2]
        longer = max(height, width)
        whole = Region(0.5 * width, 0.5 * height, longer, 0.0)
        boxes, scores = _run(self._detector, 2.0 * _cut(frame, whole, _DETECTOR_SIDE, cv2.BORDER_CONSTANT) - 1.0)
        sure = 1.0 / (1.0 + np.exp(-np.clip(scores.reshape(-1).astype(np.float64), -100.0, 100.0)))
        found = np.flatnonzero(sure >= least)
        found = found[np.argsort(-sure[found])]
        shapes = boxes.reshape(-1, 6, 2)[found] / _DETECTOR_SIDE
        shapes[:, [0, 2, 3, 4, 5]] += self._anchors[found][:, None]
        out: list[Region] = []
        while len(found) and len(out) < _MOST_PEOPLE:
            # The mean of all boxes around one person lies better than the surest of them.
            same = _shared(shapes[0, :2], shapes[:, :2]) > _SAME
            same[0] = True
            places = np.average(shapes[same, 2:4], axis=0, weights=sure[found][same])
            centre, circle = (places - 0.5) * longer + np.array([0.5 * width, 0.5 * height])
            out.append(_region(centre, circle, float(sure[found[0]])))
            found, shapes = found[~same], shapes[~same]
        return out

    def read(self, frame: Frame, region: Region) -> Reading:
        """Keypoints of the person in a region of a picture ``[H, W, 3]``."""
        output = _run(self._reader, _cut(frame, region, _SIDE))
        rows, score, heat, world = output[0].reshape(-1, 5), float(output[1].item()), output[3][0], output[4]
        places = _refined(rows[:, :2].astype(np.float64), heat)
        matrix = region.matrix(_SIDE)
        pixels = places @ matrix[:, :2].T + matrix[:, 2]
        c, s = np.cos(region.turn), np.sin(region.turn)
        positions = world.reshape(-1, 3)[:KEYPOINTS].astype(np.float64)
        positions[:, :2] = positions[:, :2] @ np.array([[c, s], [-s, c]])
        visible, present = (1.0 / (1.0 + np.exp(-rows[:KEYPOINTS, k].astype(np.float64))) for k in (3, 4))
        after = _region(pixels[_CENTRE], pixels[_CIRCLE], score)
        return Reading(pixels[:KEYPOINTS], visible * present, positions, score, after)


def _run(network: Any, picture: np.ndarray) -> list[np.ndarray]:
    network.set_tensor(network.get_input_details()[0]["index"], picture[None].astype(np.float32))
    network.invoke()
    return [network.get_tensor(detail["index"]) for detail in network.get_output_details()]


def _cut(frame: Frame, region: Region, side: int, border: int = cv2.BORDER_REPLICATE) -> np.ndarray:
    """The region as ``[side, side, 3]`` from 0 to 1."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    picture = cv2.warpAffine(frame, region.matrix(side), (side, side), flags=flags, borderMode=border)
    return picture.astype(np.float32) / 255.0


def _shared(box: Array, boxes: Array) -> Array:
    """``[N]`` intersection over union of a box ``[2, 2]`` (middle, size) with others ``[N, 2, 2]``."""
    low = np.maximum(box[0] - 0.5 * box[1], boxes[:, 0] - 0.5 * boxes[:, 1])
    high = np.minimum(box[0] + 0.5 * box[1], boxes[:, 0] + 0.5 * boxes[:, 1])
    both = np.maximum(high - low, 0.0).prod(axis=1)
    return both / np.maximum(box[1].prod() + boxes[:, 1].prod(axis=1) - both, 1e-12)


def _region(centre: Array, circle: Array, score: float) -> Region:
    """The square around the circle, turned so that the point on the circle lies above the middle."""
    across, down = circle - centre
    turn = float(np.arctan2(across, -down))
    side = 2.0 * _ROOM * float(np.hypot(across, down))
    return Region(float(centre[0]), float(centre[1]), max(side, 1.0), turn, score)


def _anchors() -> Array:
    """``[2254, 2]`` middles of the detector's cells, shares of the picture's side, one row a box."""
    rows = []
    for stride, boxes in _LAYERS:
        cells = _DETECTOR_SIDE // stride
        middles = (np.arange(cells) + 0.5) / cells
        y, x = np.meshgrid(middles, middles, indexing="ij")
        rows.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), boxes, axis=0))
    return np.concatenate(rows)


def _refined(places: Array, heat: np.ndarray) -> Array:
    """Places ``[39, 2]`` (px of the region) moved to the middle of the heat around them, where it is hot enough."""
    out = places.copy()
    half = _KERNEL // 2
    for k, (x, y) in enumerate(places * (_HEAT / _SIDE)):
        column, row = int(x), int(y)
        if not (0 <= column < _HEAT and 0 <= row < _HEAT):
            continue
        left, top = max(column - half, 0), max(row - half, 0)
        window = heat[top : row + half + 1, left : column + half + 1, k].astype(np.float64)
        window = 1.0 / (1.0 + np.exp(-window))
        if window.max() >= _LEAST_HEAT:
            rows, columns = np.indices(window.shape)
            weighted = np.array([(columns * window).sum(), (rows * window).sum()]) / window.sum()
            out[k] = (weighted + np.array([left, top])) * (_SIDE / _HEAT)
    return out
