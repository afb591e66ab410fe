"""A small blended regressor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from helpers.small_store import configuration

KERNEL = {
    "cells": 2, "reach": 2, "step": 2, "width": 0.5, "axes": 6, "whitening": 0.5, "ridge": 0.03, "length": 1.0,
    "metric_rows": 50, "centres": 1000, "share_step": 0.1,
}  # fmt: skip


def blended(folder: Path) -> dict[str, Any]:
    config = configuration(folder)
    config["regressor"] = {**config["regressor"], "cross_fit": 2, "margin": 2, "fragment_length": 16, "epochs": 2}
    config["regressor"] |= {"kernel": KERNEL}
    return config
