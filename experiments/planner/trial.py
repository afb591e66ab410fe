"""Tries settings of the planner on training takes of a run, whose states no regressor had seen.

    python experiments/planner/trial.py RUN_DIR [--frames 2600] [--only 'three*']

Whole takes are drawn by ``--seed`` until they have so many frames. Rows are in trial.yaml; each goes to raw/, and those
that are there are not run again. README.md is written from raw/.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egopose.core.atomic_write import write_text_whole
from egopose.core.config import compose_config, from_mapping
from egopose.core.safe_io import read_yaml
from egopose.data.fragments import FragmentLike
from egopose.evaluation.agents import FragmentResult, evaluate_agent
from egopose.evaluation.protocols import ContactSettings
from egopose.inference.failsafe import FailSafeSettings
from egopose.inference.planner_settings import planner_settings
from egopose.pipeline.agent import Agent, load_agent

HERE = Path(__file__).resolve().parent
SHORTEST = 90  # frames of a take
FIGURES = ("E_pose", "E_vel", "A_accl")


def drawn(fragments: Sequence[FragmentLike], frames: int, seed: int) -> list[FragmentLike]:
    """Training stretches until they have ``frames`` frames."""
    out: list[FragmentLike] = []
    for index in np.random.default_rng(seed).permutation(len(fragments)):
        fragment = fragments[index]
        if fragment.stop - fragment.start >= SHORTEST:
            out.append(fragment)
        if sum(one.stop - one.start for one in out) > frames:
            break
    return out


def row(agent: Agent, fragments: Sequence[FragmentLike], changes: dict[str, Any] | None) -> list[FragmentResult]:
    settings = compose_config("evaluate", ["checkpoint=none"])
    planner = planner_settings(settings["planner"])
    assert planner is not None
    contact = from_mapping(ContactSettings, settings["contact"], "conf/evaluate.yaml: contact")
    failsafe = from_mapping(FailSafeSettings, settings["failsafe"], "conf/evaluate.yaml: failsafe")
    names = [str(number) for number in range(len(fragments))]
    chosen = None if changes is None else replace(planner, **changes)
    return evaluate_agent(agent, fragments, names, "train", failsafe, contact, int(settings["threads"]), planner=chosen)


def figures(results: Sequence[FragmentResult]) -> dict[str, Any]:
    mean = {name: float(np.mean([one.scores.figure(name) for one in results])) for name in FIGURES}
    estimates = [one.estimate for one in results]
    counts = {
        "resets": sum(one.n_resets for one in estimates),
        "fallen": sum(int(one.fallen.sum()) for one in estimates),
    }
    return mean | counts | {"takes": len(results), "frames": sum(len(one.qpos) for one in estimates)}


def write_table() -> None:
    lines = [
        "# Looking ahead: what was tried",
        "",
        "*Written by `trial.py` from `raw/`; do not edit.* Training takes drawn by chance, states of regressors that",
        "have not seen them; the policy is that of `ours-cross-without2-seed0` of [the study](../study/README.md).",
        "",
        "```bash",
        "python experiments/planner/trial.py RUN_DIR",
        "```",
        "",
        "| planner | E_pose | E_vel | A_accl | resets | fallen frames | takes | frames |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name in read_yaml(HERE / "trial.yaml", "rows"):
        if (path := raw(name)).is_file():
            d = json.loads(path.read_text())
            numbers = " | ".join(f"{d[key]:.3f}" for key in FIGURES)
            lines.append(f"| {name} | {numbers} | {d['resets']} | {d['fallen']} | {d['takes']} | {d['frames']} |")
    write_text_whole(HERE / "README.md", "\n".join([*lines, ""]))


def raw(name: str) -> Path:
    return HERE / "raw" / f"{name.replace(',', '').replace(' ', '_')}.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=2600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="*")
    given = parser.parse_args()
    agent = load_agent(given.run, which="latest")
    fragments = drawn(agent.dataset.train, given.frames, given.seed)
    agent = replace(agent, dataset=replace(agent.dataset, train=fragments))
    for name, changes in read_yaml(HERE / "trial.yaml", "rows").items():
        if raw(name).is_file() or not fnmatch.fnmatch(name, given.only):
            continue
        result = figures(row(agent, fragments, changes))
        raw(name).parent.mkdir(exist_ok=True)
        write_text_whole(
            raw(name), json.dumps({"settings": changes, "run": given.run.name, "seed": given.seed, **result}, indent=1)
        )
        print(name, result, flush=True)
    write_table()


if __name__ == "__main__":
    main()
