"""When an episode ends before its time."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor


def fallen(state: TensorDictBase, head_body: int, lowest_head_height: Tensor, margin: float) -> Tensor:
    """``[N]``: the head is lower than the take's lowest reference head height minus ``margin`` (m).

    Args:
        state: body state.
        head_body: index of the head among the bodies.
        lowest_head_height: ``[N]`` m, of the take each world imitates.
        margin: 0.1 m in the authors' set-up.
    """
    return state["xpos"][:, head_body, 2] < lowest_head_height - margin
