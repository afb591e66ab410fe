"""MLPs in bfloat16, for processors that multiply it several times as fast as float32.

bfloat16 keeps float32's range and eight bits of its precision. Parameters stay float32, and so does all that reads what
an MLP gives: distributions, losses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor
from torchrl.modules import MLP

_ACTIVE: ContextVar[bool] = ContextVar("bfloat16_products", default=False)


def has_bfloat16_products() -> bool:
    """Whether this processor has instructions for products of bfloat16 (AVX512_BF16); False where torch cannot tell."""
    capabilities: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)  # newer than torch 2.9
    return bool(capabilities().get("avx512_bf16", False))


@contextmanager
def bfloat16_products(active: bool = True) -> Iterator[None]:
    """Inside, every :class:`MixedPrecisionMLP` computes in bfloat16, its gradients too."""
    token = _ACTIVE.set(active)
    try:
        yield
    finally:
        _ACTIVE.reset(token)


class MixedPrecisionMLP(MLP):
    """TorchRL's MLP, which heeds :func:`bfloat16_products`; what it gives is float32 all the same."""

    def forward(self, *inputs: Tensor) -> Tensor:
        """``[..., d_i]``, put side by side -> ``[..., out_features]`` float32."""
        if not _ACTIVE.get():
            return super().forward(*inputs)
        with torch.autocast("cpu", torch.bfloat16):
            return super().forward(torch.cat([part.to(torch.bfloat16) for part in inputs], dim=-1)).float()
