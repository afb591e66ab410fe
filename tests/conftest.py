"""Shared fixtures. Tests on the real mocap skip where that folder is missing; in CI it must be there."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from egopose.core.torch_settings import enable_onednn_matmul

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
