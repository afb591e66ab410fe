"""Judge the networks of run.sh: python experiments/contact_estimator/table.py CMU_PEOPLE OUT; writes result.json."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from egopose.checkpoint.contacts import load_contact_network
from egopose.core.config import compose_config, from_mapping
from egopose.data.preparation import humanoid_of
from egopose.pipeline.mocap_sources import clips_of
from egopose.training.contact_clips import ContactClip, ContactSettings, contact_clip
from egopose.training.contact_network import accuracy_table, overall

MOVING = ("pan", "zoom", "track")
DRAWS = 1


def moving(rows: dict[str, dict[str, float]], clips: list[ContactClip]) -> float:
    """Mean over the moving cameras, %."""
    return 100 * float(np.mean([overall(rows[kind], clips) for kind in MOVING]))


def main() -> None:
    """One line a network and camera; the rest goes to result.json."""
    folder, networks = Path(sys.argv[1]), Path(sys.argv[2])
    values = compose_config("contacts", [f"sources.cmu_people={folder}", "out=unused"])
    settings = from_mapping(ContactSettings, values["training"], "conf/contacts.yaml")
    humanoid = humanoid_of(values)
    clips = [contact_clip(humanoid, clip, settings) for clip in clips_of(values, "conf/contacts.yaml")[1]]
    found = [name for name in ("ours", "fixed", "paper") if (networks / name).is_dir()]
    tables = {
        name: accuracy_table(load_contact_network(networks / name / "network"), clips, settings, 200, DRAWS)
        for name in found
    }
    for name, table in tables.items():
        for camera, rows in table.items():
            shares = ", ".join(f"{kind} {100 * overall(row, clips):.1f}" for kind, row in rows.items())
            print(f"{name}, camera {camera}: {shares}")
    ours, fixed = tables["ours"], tables["fixed"]
    touching = np.concatenate([clip.contacts for clip in clips]).mean()
    result = {
        "moving": moving(ours["undone"], clips),
        "static_only_network_on_moving": moving(fixed["as seen"], clips),
        "static_only_network_on_moving_camera_undone": moving(fixed["undone"], clips),
        "gain": moving(ours["undone"], clips) - moving(fixed["as seen"], clips),
        "always_the_commoner_label": 100 * float(max(touching, 1 - touching)),
        "per_clip": {
            clip.name: 100 * float(np.mean([ours["undone"][kind][clip.name] for kind in MOVING])) for clip in clips
        },
        "by_camera": {
            name: {
                camera: {kind: 100 * overall(row, clips) for kind, row in rows.items()}
                for camera, rows in table.items()
            }
            for name, table in tables.items()
        },
        "frames": {clip.name: len(clip.points) for clip in clips},
        "camera_draws": DRAWS,
    }
    (Path(__file__).parent / "result.json").write_text(json.dumps(result, indent=1))
    print({key: round(value, 1) for key, value in result.items() if isinstance(value, float)})


if __name__ == "__main__":
    main()
