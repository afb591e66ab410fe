"""From motion capture of many people to a contact network, trained, judged and saved."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from egopose.checkpoint.contacts import save_contact_network
from egopose.core.config import from_mapping
from egopose.data.preparation import humanoid_of
from egopose.pipeline.mocap_sources import clips_of, folder_to_make
from egopose.training.contact_clips import ContactSettings, contact_clip
from egopose.training.contact_network import (
    accuracy_table,
    draw_views,
    judging_views,
    overall,
    train_contact_network,
)

_SOURCE = "conf/contacts.yaml"
_CAMERAS = 100  # seed of the cameras it is judged through: the same for every network


def train_contacts(values: Mapping[str, Any]) -> None:
    """Run ``conf/contacts.yaml``, resolved; the figures go to the terminal and to ``out/result.json``.

    Raises:
        InputError: a source or a setting cannot be used, or ``out`` is there.
    """
    out = folder_to_make(values)
    settings = from_mapping(ContactSettings, values["training"], f"{_SOURCE}: training")
    humanoid = humanoid_of(values)
    train, test = ([contact_clip(humanoid, clip, settings) for clip in part] for part in clips_of(values, _SOURCE))
    print(f"{len(train)} clips, {sum(len(clip.points) for clip in train)} frames", file=sys.stderr, flush=True)

    def tell(epoch: int, loss: float, seconds: float) -> None:
        print(f"epoch {epoch} of {settings.epochs}, loss {loss:.4f}, {seconds:.1f} s", file=sys.stderr, flush=True)

    network = train_contact_network(draw_views(train, settings), settings, tell)
    save_contact_network(network, asdict(settings), out / "network")
    print(f"network: {out / 'network'}")
    if not test:
        print("no source holds people out: nothing is judged")
        return
    table = accuracy_table(network, judging_views(test, settings, _CAMERAS))
    frames = {clip.name: len(clip.points) for clip in test}
    (out / "result.json").write_text(json.dumps({"accuracy": table, "frames": frames, "seed": settings.seed}, indent=1))
    for name, row in table.items():
        shares = ", ".join(f"{kind} {100 * overall(clips, test):.1f} %" for kind, clips in row.items())
        print(f"held-out people, camera {name}: {shares}")
