"""What is in the stores of cmu_people and tennis: ``raw/`` from the stores, README.md from ``raw/``.

``python experiments/people/people.py [STORE ...]``, the folders that ``egopose prepare`` names in its last line.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from egopose.core.config import compose_config
from egopose.data.report import minutes_by_person
from egopose.data.store import TakeStore

HERE = Path(__file__).parent
HEAD = """# More people: what of their motion can be used?

*Written by `people.py` from `raw/`; do not edit.* Two sets that come as tables of clips are prepared, motions only.
Every clip goes through the plausibility check, which refuses what nobody could have moved, and the physics gate
([docs/physics-gate.md](../../docs/physics-gate.md)) at 450 Hz. A clip that fails the gate is listed and kept.

```bash
egopose prepare data=cmu_people data.folder=PATH stages=motion
egopose prepare data=tennis data.folder=PATH stages=motion
python experiments/people/people.py STORE STORE     # the folders that these name in their last lines
```

cmu_people was prepared in two goes: all of it, and once more the people cmu94 and cmu135
(`+data.where.person=[cmu94,cmu135]`), whose files were refused before positions in the world's axes could be read.
`data=people` has the takes of both. PATH holds the table `clips.csv` and what the sets' archives unpack to. Minutes
that train or test lie on the floor, in pieces of a second and more. *Feasible* frames are those that contact with the
floor can have made. CMU: free for research and commercial use. Tennis: CC BY-SA 3.0, no weights trained on it are
shipped.
"""


def raw_of(store: TakeStore) -> dict[str, Any]:
    """What is told here of a store."""
    name = store.root.name.rsplit("-", 1)[0]
    keys = ("name", "subject", "group", "part", "length", "retargeting_mm", "gate", "feasible", "warnings", "notes")
    takes = [
        {key: getattr(take, key) for key in keys} | {"on_floor": sum(b - a for a, b in take.supported)}
        for take in store.takes
    ]
    people = minutes_by_person(store, compose_config("prepare", [f"data={name}"])["data"]["split"])
    left_out = [vars(clip) for clip in store.left_out]
    return {"set": name, "fps": store.fps, "takes": takes, "people": people, "left_out": left_out}


def joined(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Two stores of one set: a clip that either has is not refused, one that both leave out counts once."""
    takes = {take["name"]: take for take in (*first["takes"], *second["takes"])}
    left_out = {clip["name"]: clip for clip in (*first["left_out"], *second["left_out"]) if clip["name"] not in takes}
    people = {**first["people"], **second["people"]}
    return {**first, "takes": list(takes.values()), "people": people, "left_out": list(left_out.values())}


def page(raws: list[dict[str, Any]]) -> str:
    """README.md."""
    return "\n".join([HEAD, *_sets(raws), *(line for raw in raws for line in _one(raw))]) + "\n"


def _sets(raws: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| set | people | takes | minutes | train | test | refused | pass the gate | feasible | retargeting, mm |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for raw in raws:
        takes, people = raw["takes"], raw["people"].values()
        frames = sum(take["length"] for take in takes)
        refused = sum(clip["refused"] for clip in raw["left_out"])
        minutes = [sum(row[key] for row in people) for key in ("prepared", "train", "test")]
        feasible, error = (
            sum(take[key] * take["length"] for take in takes) / frames for key in ("feasible", "retargeting_mm")
        )
        lines.append(
            f"| {raw['set']} | {len(people)} | {len(takes)} | {minutes[0]:.1f} | {minutes[1]:.1f} | {minutes[2]:.1f} "
            f"| {refused} | {sum(not take['gate'] for take in takes)} of {len(takes)} | {feasible:.0%} | {error:.1f} |"
        )
    return lines


def _one(raw: dict[str, Any]) -> list[str]:
    refused = [clip for clip in raw["left_out"] if clip["refused"]]
    fails = [take for take in raw["takes"] if take["gate"]]
    lines = [
        "",
        f"## {raw['set']}",
        "",
        "| person | takes | minutes | train | test |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for person, row in sorted(raw["people"].items()):
        minutes = " | ".join(f"{row[key]:.2f}" for key in ("prepared", "train", "test"))
        lines.append(f"| {person} | {row['takes']:.0f} | {minutes} |")
    lines += ["", "### Left out", "", "| clips | minutes | why |", "| ---: | ---: | --- |"]
    for reason in sorted({clip["cause"] for clip in raw["left_out"] if not clip["refused"]}):
        seconds = [c["seconds"] or 0.0 for c in raw["left_out"] if c["cause"] == reason]
        lines.append(f"| {len(seconds)} | {sum(seconds) / 60:.1f} | {reason} |")
    lines += [
        f"| 1 | {(c['seconds'] or 0) / 60:.1f} | refused: {c['name']} ({c['subject']}): {c['cause']} |" for c in refused
    ]
    if lines[-1].startswith("| ---"):
        lines[-4:] = ["", "Nothing is left out, nothing refused."]
    if fails:
        lines += [
            "",
            "### The gate",
            "",
            "| fails | person | seconds | feasible | why |",
            "| --- | --- | ---: | ---: | --- |",
        ]
        lines += [
            f"| {t['name']} | {t['subject']} | {t['length'] / raw['fps']:.1f} | {t['feasible']:.0%} | {t['gate']} |"
            for t in fails
        ]
    said = [(take["name"], text) for take in raw["takes"] for text in (*take["warnings"], *_told(take["notes"]))]
    if said:
        lines += ["", "### Warnings, and where table and reader disagree", "", "| take | what |", "| --- | --- |"]
        lines += [f"| {name} | {text} |" for name, text in said]
    return lines


def _told(notes: list[str]) -> list[str]:
    return [note for note in notes if "the table" in note and "were cut" not in note]


def main() -> None:
    """Command line."""
    sets: dict[str, dict[str, Any]] = {}
    for folder in sys.argv[1:]:
        raw = raw_of(TakeStore.open(folder))
        sets[raw["set"]] = joined(sets[raw["set"]], raw) if raw["set"] in sets else raw
    for name, raw in sets.items():
        (HERE / "raw" / f"{name}.json").write_text(json.dumps(raw, indent=1) + "\n")
    raws = [json.loads(path.read_text()) for path in sorted((HERE / "raw").glob("*.json"))]
    (HERE / "README.md").write_text(page(raws))


if __name__ == "__main__":
    main()
