"""What a film tells of each frame beside the poses: which way is up in the body, what touches what, when it lands.

Nothing here says where the root is (Yu, Park & Lee 2021, section 5): the policy has to find that.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

#: End effectors that touch a scene, in this order everywhere.
EFFECTORS = ("right_foot", "left_foot", "right_hand", "left_hand")
FEET = 2


@dataclass(frozen=True)
class ClipHints:
    """Hints of T frames, or of the frames that N worlds are in.

    Args:
        up: ``[T]`` rad between the way from the pelvis to the head and the vertical.
        touches: ``[T, 4, 1 + K]`` bool, whether each of :data:`EFFECTORS` should touch the floor (first) and each box.
        landing_after: ``[T]`` int64 frames to the next landing, of frames in which nothing should touch; else 0.
        landing_effector: ``[T]`` int64 which of the effectors lands.
        landing_on: ``[T]`` int64 on what: 0 the floor, k + 1 box k.
        landing_reach: ``[T]`` m from the centre of mass to that effector in the pose of the landing.
        com_height: ``[T]`` m, the centre of mass over the lowest joint of the pose.
        trust: ``[T]`` how sure the poses are, 1 as sure as usual: the paper's keyframes by hand have 0.1 of 0.35.
        box_sizes: ``[K, 2]`` m, lengths and widths of the boxes' upper faces.
    """

    up: Tensor
    touches: Tensor
    landing_after: Tensor
    landing_effector: Tensor
    landing_on: Tensor
    landing_reach: Tensor
    com_height: Tensor
    trust: Tensor
    box_sizes: Tensor

    def at(self, frame: Tensor) -> ClipHints:
        """The rows of frames ``[N]``."""
        rows = {f.name: getattr(self, f.name).index_select(0, frame) for f in fields(self) if f.name != "box_sizes"}
        return replace(self, **rows)


def landings(touches: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``landing_after``, ``landing_effector`` and ``landing_on`` of :class:`ClipHints` from its ``touches``."""
    frames = len(touches)
    after, effector, on = torch.zeros(3, frames, dtype=torch.int64)
    anything = touches.flatten(1).any(1).tolist()
    landing: int | None = None
    for t in range(frames - 1, -1, -1):
        if anything[t]:
            landing = t
        elif landing is not None:
            what = touches[landing].nonzero()[0]
            after[t], effector[t], on[t] = landing - t, what[0], what[1]
    return after, effector, on


def hints_of(
    up: Tensor, touches: Tensor, points: Tensor, com: Tensor, lowest: Tensor, trust: Tensor, box_sizes: Tensor
) -> ClipHints:
    """The hints of a clip.

    Args:
        up, touches, trust, box_sizes: see :class:`ClipHints`.
        points: ``[T, 4, 3]`` m, the effectors' in the poses, wherever the root is.
        com: ``[T, 3]`` m, the centre of mass beside them.
        lowest: ``[T]`` m, height of the lowest joint beside them.
    """
    after, effector, on = landings(touches)
    landing = torch.arange(len(touches)) + after
    reach = (com[landing] - points[landing, effector]).norm(dim=-1)
    return ClipHints(up, touches, after, effector, on, reach, com[:, 2] - lowest, trust, box_sizes)
