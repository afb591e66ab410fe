"""GoPro's lens fields: the letter VFOV of the mode, and ZFOV, the angle across the picture's diagonal."""

from __future__ import annotations

import numpy as np

#: Modes by their letter, as GoPro's own tools name them.
LENSES = {
    "L": "linear",
    "W": "wide",
    "M": "medium",
    "N": "narrow",
    "S": "superview",
    "H": "hyperview",
    "X": "max superview",
}


def lens_name(letter: str) -> str:
    """``linear`` of ``L``; of a letter that is not known, the letter."""
    return LENSES.get(letter, letter)


def lens_letter(name: str) -> str:
    """``L`` of ``linear``; other names stand for themselves."""
    return next((letter for letter, known in LENSES.items() if known == name), name)


def is_pinhole(lens: str | None) -> bool:
    """Whether straight lines stay straight: only in the linear mode."""
    return lens == "linear"


def across_width(diagonal: float, lens: str | None, width: float, height: float) -> float:
    """Degrees across the width from those across the diagonal.

    A linear picture is a pinhole's, others are equidistant: the radius goes with the angle. Superview and hyperview
    stretch the sides of the picture, so for them it holds in the middle only.
    """
    share = width / float(np.hypot(width, height))
    if is_pinhole(lens):
        return float(np.rad2deg(2 * np.arctan(share * np.tan(np.deg2rad(0.5 * diagonal)))))
    return diagonal * share


def across_diagonal(across: float, lens: str | None, width: float, height: float) -> float:
    """The inverse of :func:`across_width`, degrees."""
    share = width / float(np.hypot(width, height))
    if is_pinhole(lens):
        return float(np.rad2deg(2 * np.arctan(np.tan(np.deg2rad(0.5 * across)) / share)))
    return across / share
