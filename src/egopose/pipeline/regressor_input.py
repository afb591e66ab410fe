"""What a state regressor looks at of a store: its flow, and where it sees limbs what the finder makes of them.

The finder's rows are a table of the store, made from the takes' videos when a regressor first asks for them.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egopose.checkpoint.body_parts import load_body_part_estimator
from egopose.data.preparation import video_of
from egopose.data.store import TakeStore
from egopose.models.predictions import Flow
from egopose.vision.body_parts import BodyPartEstimator, as_plane
from egopose.vision.features import extract_body_parts
from egopose.vision.flow import FlowConfig
from egopose.vision.lens import Camera

_KEY = "body_parts"


class FlowAndBodyParts:
    """Flow ``[F, 2, S, S]`` and rows ``[F, N]`` as one table ``[F, 3, S, S]``, put together as it is read."""

    def __init__(self, flow: Tensor, rows: Tensor) -> None:
        self._flow, self._rows = flow, rows

    @property
    def ndim(self) -> int:
        return self._flow.ndim

    def __len__(self) -> int:
        return len(self._flow)

    def __getitem__(self, frames: slice | NDArray[np.integer]) -> NDArray[np.float16]:
        index = frames if isinstance(frames, slice) else torch.as_tensor(frames)
        flow, rows = (np.asarray(table[index], dtype=np.float16) for table in (self._flow, self._rows))
        return np.concatenate([flow, as_plane(rows, flow.shape[-1])], axis=1)


def body_part_estimator_name(regressor: Mapping[str, Any]) -> str | None:
    """The name of the body-part estimator in a group ``regressor``; None if only flow is read."""
    kernel = regressor.get("kernel")
    return None if kernel is None else kernel.get(_KEY)


def planes_of(regressor: Mapping[str, Any]) -> int:
    """Planes of a frame that a group ``regressor`` looks at: flow's two, a third with limbs."""
    return 2 if body_part_estimator_name(regressor) is None else 3


def load_body_part_estimator_of(regressor: Mapping[str, Any]) -> BodyPartEstimator | None:
    """The body-part estimator of a group ``regressor``. Raises InputError: there is none of that name."""
    name = body_part_estimator_name(regressor)
    return None if name is None else load_body_part_estimator(name)


def body_part_fingerprint(name: str) -> str:
    """Of a finder's weights: other weights, other rows."""
    digest = hashlib.sha256()
    for key, value in sorted(load_body_part_estimator(name).state_dict().items()):
        digest.update(key.encode() + np.ascontiguousarray(value.numpy()).tobytes())
    return digest.hexdigest()


def seen_in_store(
    config: Mapping[str, Any], regressor: Mapping[str, Any], store: TakeStore, flow_name: str, keep: bool = False
) -> Flow:
    """What a regressor reads of the whole store.

    Args:
        config: resolved; whose videos they are.
        regressor: the group it was, or will be, made with.
        store: with flow.
        flow_name: the flow's name in the store.
        keep: write the finder's rows to the store where they are not there; its lock is held.

    Raises:
        InputError: the store lacks flow, or a video is not there.
    """
    flow, name = store.flow(flow_name), body_part_estimator_name(regressor)
    if name is None:
        return flow
    table = (
        f"body_parts-{hashlib.sha256(json.dumps([flow_name, body_part_fingerprint(name)]).encode()).hexdigest()[:12]}"
    )
    if store.has_table(table):
        return FlowAndBodyParts(flow, store.table(table)[_KEY])
    rows = _find_body_parts(config, store, flow, load_body_part_estimator(name))
    if keep:
        store.write_table(table, {_KEY: rows}, {"flow": flow_name, "finder": name})
    return FlowAndBodyParts(flow, rows)


def _find_body_parts(config: Mapping[str, Any], store: TakeStore, flow: Tensor, finder: BodyPartEstimator) -> Tensor:

    print(f"finding limbs in {store.frames_total} pictures", file=sys.stderr, flush=True)
    if not all(take.rendered for take in store.takes):
        reported = "the body-part estimator has never seen a filmed body: compare with regressor.kernel.body_parts=null"
        print(f"note: {reported}", file=sys.stderr, flush=True)
    settings = FlowConfig(**dict(config["vision"]["flow"]))
    rows = []
    for index, take in enumerate(store.takes):
        camera = Camera.from_mapping(take.camera, take.name) if take.camera else None
        seen = np.asarray(flow[store.frames(index)])
        video = video_of(config, store, index)
        rows.append(extract_body_parts(video, seen, settings, finder, store.fps, take.sync_offset, camera))
    return torch.from_numpy(np.concatenate(rows))
