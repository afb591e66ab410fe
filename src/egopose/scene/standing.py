"""Where a reference motion stands among boxes: it is moved so that its feet land on the boxes as they are in a world.

A kinematic motion knows a box by a first guess. In a world where the box is higher or further away, the motion on it is
moved along, and what lies between two supports is moved by what lies between. All of it is linear in the boxes' places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from egopose.motion.contacts import runs_of
from egopose.motion.rotations import Array
from egopose.scene.root import Support

#: s: a body takes about this long to move its weight from one support to the next.
_SHIFT_OF_WEIGHT = 0.1
#: m that a foot's middle stays within a box's edge.
_MARGIN = 0.1


@dataclass(frozen=True)
class Standing:
    """The supports of a motion and what each is on.

    Args:
        share: ``[T, S]`` of each support in each frame; rows sum to 1.
        box: ``[S]`` number of the box, -1 for the floor.
        height: ``[S]`` m, at which the motion's own foot stood.
        place: ``[S, 2]`` m, where its foot stood.
    """

    share: Array
    box: NDArray[np.int64]
    height: Array
    place: Array

    def surfaces(self, tops: Array) -> Array:
        """``[n, S]`` m: what each support is on, for boxes with upper faces at ``tops [n, K, 3]``."""
        return np.where(self.box < 0, 0.0, self._of_box(tops)[..., 2])

    def ground(self, tops: Array) -> Array:
        """``[n, T]`` m: the height of what the body stands on, for boxes at ``tops [n, K, 3]``."""
        return self.surfaces(tops) @ self.share.T

    def moves(self, tops: Array, headings: Array, sizes: Array) -> Array:
        """``[n, T, 3]`` m: how far the motion is to be moved; see :meth:`moves_of_supports`."""
        return np.einsum("ts,nsd->ntd", self.share, self.moves_of_supports(tops, headings, sizes))

    def moves_of_supports(self, tops: Array, headings: Array, sizes: Array) -> Array:
        """``[n, S, 3]`` m: how far each support is to be moved.

        Vertically by the height of what it is on less that at which the motion's foot stood. Level by what brings the
        foot onto the box's upper face, and no further.

        Args:
            tops: ``[n, K, 3]`` m, centres of the upper faces.
            headings: ``[n, K]`` rad.
            sizes: ``[K, 2]`` m.
        """
        out = np.zeros((len(tops), len(self.box), 3))
        out[..., 2] = self.surfaces(tops) - self.height
        on = np.flatnonzero(self.box >= 0)
        if len(on):
            box = self.box[on]
            yaw = headings[:, box]
            cos, sin = np.cos(yaw), np.sin(yaw)
            away = self.place[on] - tops[:, box, :2]
            along, across = in_box_axes(away, yaw)
            room = np.maximum(0.5 * sizes[box] - _MARGIN, 0.0)
            back = np.clip(along, -room[:, 0], room[:, 0]) - along
            side = np.clip(across, -room[:, 1], room[:, 1]) - across
            out[:, on, 0], out[:, on, 1] = cos * back - sin * side, sin * back + cos * side
        return out

    def _of_box(self, tops: Array) -> Array:
        return tops[:, np.maximum(self.box, 0)] if tops.shape[1] else np.zeros((len(tops), len(self.box), 3))


def in_box_axes(level: Array, headings: Array) -> tuple[Array, Array]:
    """Level vectors ``[..., 2]`` along and across boxes of ``headings [...]`` rad."""
    cos, sin = np.cos(headings), np.sin(headings)
    return cos * level[..., 0] + sin * level[..., 1], cos * level[..., 1] - sin * level[..., 0]


def standing(supports: Sequence[Support], boxes: Sequence[int], feet: Array, frames: int, fps: float) -> Standing:
    """The supports of a motion, and how much each carries in each frame.

    Between two supports the share moves in proportion to time; where both feet stand, they share alike.

    Args:
        supports: in order of time; heights over the floor, as in the motion.
        boxes: of each support the number of its box, -1 for the floor.
        feet: ``[T, F, 2]`` m, where the feet are.
        frames: T.
        fps: frames per second.

    Raises:
        ValueError: there is no support.
    """
    if not supports:
        raise ValueError("the motion stands on nothing: no support is known")
    share = np.zeros((frames, len(supports)))
    for k, support in enumerate(supports):
        share[support.start : support.stop, k] = 1.0
    for start, stop in runs_of(share.sum(axis=1) == 0):
        # At the clip's ends there is one side alone, and it holds.
        leaves = _normalised(share[start - 1] if start else share[stop])
        lands = _normalised(share[stop] if stop < frames else share[start - 1])
        part = ((np.arange(start, stop) - start + 1) / (stop - start + 1))[:, None]
        share[start:stop] = (1 - part) * leaves + part * lands
    share = gaussian_filter1d(_normalised(share), _SHIFT_OF_WEIGHT * fps, axis=0, mode="nearest")
    places = np.stack([np.median(feet[s.start : s.stop, s.foot], axis=0) for s in supports])
    return Standing(
        _normalised(share), np.asarray(boxes, dtype=np.int64), np.array([s.height for s in supports]), places
    )


def _normalised(share: Array) -> Array:
    return share / share.sum(axis=-1, keepdims=True).clip(min=1e-12)
