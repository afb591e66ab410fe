"""When an episode ends before its time."""

from __future__ import annotations

from torch import Tensor


def fallen(head_height: Tensor, lowest_head_height: Tensor, margin: float | Tensor) -> Tensor:
    """``[N]``: the head is lower than the take's lowest reference head height minus ``margin`` (m).

    Args:
        head_height: ``[N]`` m.
        lowest_head_height: ``[N]`` m, of the take each world imitates.
        margin: 0.1 m in the authors' set-up; a number or ``[N]``.
    """
    return head_height < lowest_head_height - margin
