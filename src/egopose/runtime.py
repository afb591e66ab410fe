"""What must be set before torch is imported. This module imports nothing heavy."""

from __future__ import annotations

import os


def prepare_runtime() -> None:
    """Call first in every main, before anything imports torch.

    OpenMP's idle threads spin by default and starve the physics' threads of the same cores; these settings make them
    sleep. Values already in the environment win.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
