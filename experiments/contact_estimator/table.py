"""Judge the networks of train.py: python experiments/contact_estimator/table.py CMU_PEOPLE OUT; writes result.json.

What real.py and causes.py have written is taken up.
"""

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
from egopose.training.contact_network import accuracy_table, judging_views, overall

MOVING = ("pan", "zoom", "track")
DRAWS, CAMERAS = 3, 200
HERE = Path(__file__).parent
Table = dict[str, dict[str, dict[str, float]]]


def test_clips(folder: Path) -> tuple[list[ContactClip], ContactSettings]:
    """Clips of people that no network has seen, and ``conf/contacts.yaml``."""
    values = compose_config("contacts", [f"sources.cmu_people={folder}", "out=unused"])
    settings = from_mapping(ContactSettings, values["training"], "conf/contacts.yaml")
    humanoid = humanoid_of(values)
    return [contact_clip(humanoid, clip, settings) for clip in clips_of(values, "conf/contacts.yaml")[1]], settings


def moving(rows: dict[str, dict[str, float]], clips: list[ContactClip]) -> float:
    """Mean over the moving cameras, %."""
    return 100 * float(np.mean([overall(rows[kind], clips) for kind in MOVING]))


def real(part: str) -> dict[str, object]:
    """``real_panning`` of ``ours`` and of ``part`` with what belongs to it, if real.py has run."""
    if not (HERE / "real.json").is_file():
        return {}
    shares = json.loads((HERE / "real.json").read_text())["shares"]

    def mean(name: str, way: str) -> float:
        return float(np.mean([ways[way] for key, ways in shares.items() if key.rsplit("_", 1)[0] == name]))

    return {
        "real_panning": mean("ours", "undone"),
        "real_panning_as_seen": mean("ours", "as seen"),
        "static_only_network_on_real_panning": mean(part, "as seen"),
        "real_panning_by_network": shares,
    }


def main() -> None:
    """One line a network and camera; the rest goes to result.json."""
    clips, settings = test_clips(Path(sys.argv[1]))
    views = judging_views(clips, settings, CAMERAS, DRAWS)
    tables: dict[str, dict[str, Table]] = {}
    for folder in sorted(Path(sys.argv[2]).iterdir()):
        name, seed = folder.name.rsplit("_", 1)
        tables.setdefault(name, {})[seed] = accuracy_table(load_contact_network(folder), views)
    by_camera = {
        name: {
            camera: {
                kind: float(np.mean([100 * overall(table[camera][kind], clips) for table in seeds.values()]))
                for kind in views
            }
            for camera in ("undone", "as seen")
        }
        for name, seeds in tables.items()
    }
    for name, ways in by_camera.items():
        for camera, row in ways.items():
            print(f"{name}, camera {camera}: {', '.join(f'{kind} {share:.1f}' for kind, share in row.items())}")
    ours = [moving(table["undone"], clips) for table in tables["ours"].values()]
    fixed = [moving(table["as seen"], clips) for table in tables["fixed"].values()]
    undone = [moving(table["undone"], clips) for table in tables["fixed"].values()]
    touching = np.concatenate([clip.contacts for clip in clips]).mean()
    result = {
        "moving": float(np.mean(ours)),
        "moving_of_seeds": ours,
        "static_only_network_on_moving": float(np.mean(fixed)),
        "static_only_of_seeds": fixed,
        "static_only_network_on_moving_camera_undone": float(np.mean(undone)),
        "gain": float(np.mean(ours) - np.mean(fixed)),
        **real("fixed"),
        "always_the_commoner_label": 100 * float(max(touching, 1 - touching)),
        "per_clip": {
            clip.name: 100
            * float(np.mean([table["undone"][kind][clip.name] for table in tables["ours"].values() for kind in MOVING]))
            for clip in clips
        },
        "by_camera": by_camera,
        "frames": {clip.name: len(clip.points) for clip in clips},
        "camera_draws": DRAWS,
    }
    (HERE / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    print({key: round(value, 1) for key, value in result.items() if isinstance(value, float)})


if __name__ == "__main__":
    main()
