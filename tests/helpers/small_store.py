"""A store of two short clips with flow, and the configuration of a small run on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from egopose.core.config import compose_config
from egopose.data.preparation import flow_name, store_folder
from egopose.data.store import TakeStore
from helpers.mocap import short_clips


def configuration(folder: Path) -> dict[str, Any]:
    """Two short embedded clips, the quick simulation, a small flow and small networks."""
    return compose_config(
        "train",
        [
            *short_clips(folder),
            "data.split.train_share=0.5",
            "data.split.shortest=8",
            "vision.flow.stored_size=8",
            "vision.encoder.input_size=8",
            "vision.encoder.features=6",
            "vision.encoder.channels=[4]",
            "regressor.hidden=[8]",
            "regressor.context_size=4",
            "regressor.epochs=4",
            "regressor.save_every=1",
            "model.hidden=[8]",
            "collector=sync",
            "collector.num_envs=2",
            "collector.physics_threads=1",
            "algo.steps_per_iteration=8",
            "algo.iterations=1",
            "algo.minibatch_size=8",
            "seed=3",
        ],
    )


def fill_flow(config: dict[str, Any]) -> None:
    """Noise in place of rendered video's flow, noted as done."""
    store = TakeStore.open(store_folder(config))
    name, generator = flow_name(config), torch.Generator().manual_seed(0)
    flow = store.open_flow(name, int(config["vision"]["flow"]["stored_size"]))
    flow.copy_(0.05 * torch.randn(flow.shape, generator=generator))
    for take in range(len(store.takes)):
        store.mark_flow(name, take)
