"""MLPs with their hidden layers in bfloat16, for processors that multiply it several times as fast as float32.

bfloat16 keeps float32's range and eight bits of its precision. Parameters, and what the last layer gives, stay float32:
a mean action rounded to eight bits would move the ratio of probabilities that PPO clips.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor
from torchrl.modules import MLP

_HALVED: ContextVar[bool] = ContextVar("bfloat16_layers", default=False)


def has_bfloat16_products() -> bool:
    """Whether this processor has instructions for products of bfloat16 (AVX512_BF16); False where torch cannot tell."""
    # Not there before torch 2.10; on other processors than Intel's and AMD's without this entry.
    capabilities: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)
    return bool(capabilities().get("avx512_bf16", False))


@contextmanager
def bfloat16_layers(active: bool = True) -> Iterator[None]:
    """Inside, every :class:`MixedPrecisionMLP` computes its hidden layers in bfloat16, and their gradients."""
    token = _HALVED.set(active)
    try:
        yield
    finally:
        _HALVED.reset(token)


class MixedPrecisionMLP(MLP):
    """TorchRL's MLP, which heeds :func:`bfloat16_layers`; its result is float32 all the same."""

    def forward(self, *inputs: Tensor) -> Tensor:
        """``[..., d_i]``, put side by side -> ``[..., out_features]``."""
        if not _HALVED.get():
            return super().forward(*inputs)
        *layers, last = self
        with torch.autocast("cpu", torch.bfloat16):
            hidden = torch.cat([part.to(torch.bfloat16) for part in inputs], dim=-1)
            for layer in layers:
                hidden = layer(hidden)
        return last(hidden.float())
