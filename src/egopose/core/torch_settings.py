"""What must be set before torch and dm_control are imported. This module imports nothing heavy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch


@cache
def enable_onednn_matmul() -> bool:
    """Have torch multiply matrices by oneDNN where that keeps single precision; True where it does from here on.

    MKL, torch's own choice, leaves the 512-bit units of AMD's processors idle: oneDNN takes less than half the time
    there. Torch has no other switch for it than the one that *allows* oneDNN to round the factors to bfloat16, which it
    does on processors made for that. So the digits are looked at, and where they are fewer all stays as it was.
    """

    setting: Any = getattr(torch.backends.mkldnn, "matmul")  # noqa: B009 made when asked for: unknown to mypy
    before = setting.fp32_precision
    setting.fp32_precision = "bf16"
    if not all(_keeps_single_precision(*sizes) for sizes in ((64, 473, 300), (2048, 300, 200), (300, 2048, 473))):
        setting.fp32_precision = before
        return False
    return True


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """``count`` threads for torch inside, what it was before after; quick products from here on.

    Both decide the last digits, and a body that falls tells them: the same figures again need the same of both.
    """

    enable_onednn_matmul()
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _keeps_single_precision(rows: int, inner: int, columns: int) -> bool:

    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(shape, generator=generator) for shape in ((rows, inner), (inner, columns)))
    exact = a.double() @ b.double()
    return bool((a @ b - exact).norm() < 2e-6 * exact.norm())  # bfloat16: 2e-3
