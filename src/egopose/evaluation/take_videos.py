"""From the resolved configuration to the objects it names; the one place where the rooms meet.

The way of training: store of takes -> state regressor's tables -> environment -> networks -> PPO.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from egopose.data.preparation import store_folder, video_of
from egopose.data.store import TakeStore
from egopose.inference.outputs import TakeVideo


def take_videos(config: Mapping[str, Any]) -> tuple[list[str], list[TakeVideo | None]]:
    """Names of all takes of a prepared configuration, and the wearer's video of each where its file is there.

    Raises:
        InputError: the data is not prepared.
    """
    store = TakeStore.open(store_folder(config))
    videos = [
        TakeVideo(path, take.sync_offset, take.rendered, (take.camera or {}).get("fps"))
        if (path := video_of(config, store, i)).is_file()
        else None
        for i, take in enumerate(store.takes)
    ]
    return [take.name for take in store.takes], videos
