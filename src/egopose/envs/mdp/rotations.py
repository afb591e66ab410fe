"""Rotations in torch: quaternions ``wxyz``, batch axes lead; the twin of :mod:`egopose.motion.rotations`."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

# (p * q)_r = sum_c sign[r, c] p[index[r, c]] q_c: one small matrix product instead of sixteen strided ones.
_INDEX = (0, 1, 2, 3, 1, 0, 3, 2, 2, 3, 0, 1, 3, 2, 1, 0)
_SIGN = (1.0, -1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0)


@cache
def _index(device: torch.device) -> Tensor:
    return torch.tensor(_INDEX, device=device)


@cache
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Made once: making a small tensor costs more than the arithmetic on it."""
    return torch.tensor(values, dtype=dtype, device=device)


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product ``p * q`` of ``[..., 4]`` quaternions (first q, then p)."""
    left = p.index_select(-1, _index(p.device)) * _constant(_SIGN, p.dtype, p.device)
    return torch.matmul(left.unflatten(-1, (4, 4)), q.unsqueeze(-1)).squeeze(-1)


def conjugate(q: Tensor) -> Tensor:
    """Inverse of unit quaternions ``[..., 4]``."""
    return q * _constant((1.0, -1.0, -1.0, -1.0), q.dtype, q.device)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors ``[..., 3]`` turned by unit quaternions ``[..., 4]``; the batch axes broadcast."""
    w, u = q[..., :1], q[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    t = 2.0 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def heading(q: Tensor) -> Tensor:
    """Heading ``[..., 4]``: keep (w, z), zero (x, y), renormalise. A half turn about a level axis has heading zero."""
    kept = q * _constant((1.0, 0.0, 0.0, 1.0), q.dtype, q.device)
    norm = kept.norm(dim=-1, keepdim=True)
    identity = _constant((1.0, 0.0, 0.0, 0.0), q.dtype, q.device)
    return torch.where(norm > 1e-12, kept / norm.clamp_min(1e-12), identity)


def dehead(q: Tensor) -> Tensor:
    """``inv(heading(q)) * q`` ``[..., 4]``: w is never negative and z is zero, whichever sign q comes with."""
    return multiply(conjugate(heading(q)), q)


def half_angle(q: Tensor) -> Tensor:
    """Half the rotation angle ``[...]`` (rad, at most pi/2) of unit quaternions, the short way round.

    By atan2, which keeps its precision at small angles, where arccos(w) loses half the digits.
    """
    return torch.atan2(q[..., 1:].norm(dim=-1), q[..., 0].abs())
