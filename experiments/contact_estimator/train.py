"""Train the networks that are compared: python experiments/contact_estimator/train.py CMU_PEOPLE CMU6 OUT [NAME ...].

The seeds of one training share its views, which are drawn once; weights, cuts, mirror images and order differ.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from egopose.checkpoint.contacts import save_contact_network
from egopose.core.config import compose_config, from_mapping
from egopose.data.preparation import humanoid_of
from egopose.pipeline.mocap_sources import clips_of
from egopose.training.contact_clips import ContactSettings, contact_clip
from egopose.training.contact_network import draw_views, train_contact_network

_FIXED = {"fixed": 1.0, "pan": 0.0, "zoom": 0.0, "track": 0.0}
_PAPER: dict[str, Any] = {
    "network": "windows",
    "widths": (1024, 512, 128, 32),
    "dropout": 0.3,
    "input_noise": 0.005,
    "views": 6,
    "epochs": 6,
    "batch": 256,
    "learning_rate": 0.002,
    "weight_decay": 0.0,
}
#: What each training changes in conf/contacts.yaml, and its seeds.
TRAININGS: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "ours": ({}, (0, 1, 2)),
    "fixed": ({"cameras": _FIXED}, (0, 1, 2)),
    "paper": ({**_PAPER, "undone": 0.0}, (0,)),
    "paper_undone": (_PAPER, (0,)),
    "all_labels": ({"doubtful_height": 0.03}, (0,)),
    "exact": ({"error": (0.0, 0.0), "dropped": 0.0}, (0,)),
}
#: ``exact`` is made only when it is named: it has seen no errors of keypoints, and is judged without them.
_COMPARED = [name for name in TRAININGS if name != "exact"]


def main() -> None:
    """A folder OUT/NAME_SEED for each network; those that are there stay."""
    people, cmu6, out = sys.argv[1:4]
    values = compose_config("contacts", [f"sources.cmu_people={people}", f"sources.cmu6={cmu6}", "out=unused"])
    shipped = from_mapping(ContactSettings, values["training"], "conf/contacts.yaml")
    humanoid = humanoid_of(values)
    motions = clips_of(values, "conf/contacts.yaml")[0]
    print(f"{len(motions)} clips, {sum(len(motion) for motion in motions)} frames", flush=True)
    for name in sys.argv[4:] or _COMPARED:
        changed, seeds = TRAININGS[name]
        settings = replace(shipped, **changed)
        folders = {seed: Path(out) / f"{name}_{seed}" for seed in seeds}
        if all(folder.exists() for folder in folders.values()):
            continue
        views = draw_views([contact_clip(humanoid, motion, settings) for motion in motions], settings)
        print(f"{name}: views are drawn", flush=True)
        for seed, folder in folders.items():
            if folder.exists():
                continue
            print(folder.name, flush=True)
            network = train_contact_network(views, replace(settings, seed=seed), _tell)
            save_contact_network(network, asdict(replace(settings, seed=seed)), folder)


def _tell(epoch: int, loss: float, seconds: float) -> None:
    print(f"epoch {epoch}, loss {loss:.4f}, {seconds:.1f} s", flush=True)


if __name__ == "__main__":
    main()
