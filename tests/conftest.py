"""Shared fixtures. Tests on the real mocap skip where that folder is missing; in CI it must be there."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from absl import logging as absl_logging

from egopose.core.torch_settings import enable_onednn_matmul

# absl writes to what is `sys.stderr` at its import, here a buffer of pytest's, and closes it when a library configures
# logging: Hydra looks at its plugins, and submitit's does. It never closes `sys.__stderr__`.
absl_logging.get_absl_handler().python_handler.stream = sys.__stderr__

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


@pytest.fixture(scope="session", autouse=True)
def one_way_of_multiplying() -> None:
    """Training chooses it for the process: results to the bit must not depend on the tests that ran before."""
    enable_onednn_matmul()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real motion capture beside the checkout; ``shared / "data"`` holds the sets."""
    if not (SHARED / "data").is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"the mocap folder {SHARED} is missing, and CI must have it")
        pytest.skip("the mocap folder ../shared is not here: it is not part of the project")
    return SHARED
