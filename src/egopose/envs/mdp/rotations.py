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


def matrix(q: Tensor) -> Tensor:
    """Rotation matrices ``[..., 3, 3]`` of unit quaternions ``[..., 4]``: ``matrix(q) @ v`` is v turned by q."""
    products = (q.unsqueeze(-1) * q.unsqueeze(-2)).flatten(-2)
    return torch.matmul(products, _matrix_of_products(q.dtype, q.device)).unflatten(-1, (3, 3))


@cache
def _matrix_of_products(dtype: torch.dtype, device: torch.device) -> Tensor:
    """``[16, 9]``: from the products ``q_i q_j`` to the entries of the rotation matrix, which are linear in them."""
    out = torch.zeros(4, 4, 3, 3, dtype=dtype)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for part, sign in ((0, 1.0), (i + 1, 1.0), (j + 1, -1.0), (k + 1, -1.0)):
            out[part, part, i, i] = sign
        out[i + 1, j + 1, i, j] = out[i + 1, j + 1, j, i] = 2.0
        out[0, k + 1, i, j], out[0, k + 1, j, i] = -2.0, 2.0
    return out.reshape(16, 9).to(device)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors ``[..., 3]`` turned by unit quaternions ``[..., 4]``; the batch axes broadcast."""
    return torch.matmul(matrix(q), v.unsqueeze(-1)).squeeze(-1)


def heading(q: Tensor) -> Tensor:
    """Heading ``[..., 4]``: keep (w, z), zero (x, y), renormalise. A half turn about a level axis has heading zero."""
    keep = _constant((1.0, 0.0, 0.0, 1.0), q.dtype, q.device)
    # What is added is below rounding unless (w, z) vanishes; there it makes the identity of it.
    kept = torch.addcmul(_constant((1e-16, 0.0, 0.0, 0.0), q.dtype, q.device), q, keep)
    return kept / torch.linalg.vector_norm(kept, dim=-1, keepdim=True)


def yaw(q: Tensor) -> Tensor:
    """Angle ``[...]`` of the :func:`heading` of quaternions ``[..., 4]``, rad; zero faces along x."""
    return wrapped(2.0 * torch.atan2(q[..., 3], q[..., 0]))


def wrapped(angle: Tensor) -> Tensor:
    """Angles ``[...]`` in rad, the same directions within [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def turn_back(heading: Tensor, q: Tensor) -> Tensor:
    """``conj(heading) * q`` of a :func:`heading` and quaternions, both ``[..., 4]``.

    Plain products and sums: unlike matrix products they round alike however many rows there are.
    """
    swapped = q.flip(-1) * _constant((1.0, 1.0, -1.0, -1.0), q.dtype, q.device)
    return heading[..., :1] * q + heading[..., 3:] * swapped


def rotate_back(heading: Tensor, v: Tensor) -> Tensor:
    """Vectors ``[..., 3]`` of the world in the frame of a :func:`heading` ``[..., 4]``; rounds as :func:`turn_back`."""
    w, z = heading[..., :1], heading[..., 3:]
    cos, sin = w * w - z * z, 2.0 * w * z
    x, y, up = v.unbind(-1)
    x, y = x.unsqueeze(-1), y.unsqueeze(-1)
    return torch.cat([cos * x + sin * y, cos * y - sin * x, up.unsqueeze(-1)], dim=-1)


def half_angle_between(p: Tensor, q: Tensor) -> Tensor:
    """Half the angle ``[...]`` (rad, at most pi/2) of the rotation ``p * conj(q)``, the short way round.

    It is the angle in four dimensions between p and the nearer of q and -q, as ``2 atan2(|p - q|, |p + q|)``
    (Kahan). This keeps its precision at small angles, where arccos loses half the digits.
    """
    apart = torch.linalg.vector_norm(p - q, dim=-1)
    together = torch.linalg.vector_norm(p + q, dim=-1)
    return 2.0 * torch.atan2(torch.minimum(apart, together), torch.maximum(apart, together))
