"""Tries planners on training takes of a run, whose states no regressor had seen.

    python experiments/planner/trial.py RUN_DIR [--frames 1500] [--only 'gauss*']

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
from egopose.inference.planners import read_planner
from egopose.pipeline.agent import Agent, load_agent

HERE = Path(__file__).resolve().parent
SHORTEST = 90  # frames of a take
FIGURES = ("E_pose", "E_vel", "A_accl", "E_key", "mpjpe_root_aligned", "mpjpe", "root_drift", "foot_skate")


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


def row(agent: Agent, fragments: Sequence[FragmentLike], overrides: Sequence[str]) -> list[FragmentResult]:
    settings = compose_config("evaluate", ["checkpoint=none", *overrides])
    contact = from_mapping(ContactSettings, settings["contact"], "conf/evaluate.yaml: contact")
    failsafe = from_mapping(FailSafeSettings, settings["failsafe"], "conf/evaluate.yaml: failsafe")
    names, planner = [str(number) for number in range(len(fragments))], read_planner(settings["planner"])
    return evaluate_agent(
        agent, fragments, names, "train", failsafe, contact, int(settings["threads"]), planner=planner
    )


def figures(results: Sequence[FragmentResult]) -> dict[str, Any]:
    """Means over takes, of the bodies and of the regressor they follow."""

    def means(of: str) -> dict[str, float]:
        return {name: float(np.mean([getattr(one, of).figure(name) for one in results])) for name in FIGURES}

    estimates = [one.estimate for one in results]
    return {
        "figures": means("scores"),
        "regressor": means("pose_regression_scores"),
        "true A_accl": float(np.mean([one.reference_scores.figure("A_accl") for one in results])),
        "resets": sum(one.n_resets for one in estimates),
        "fallen": sum(int(one.fallen.sum()) for one in estimates),
        "takes": len(results),
        "frames": sum(len(one.qpos) for one in estimates),
    }


def write_table() -> None:
    rows = {
        name: json.loads(path.read_text())
        for name in read_yaml(HERE / "trial.yaml", "rows")
        if (path := raw(name)).is_file()
    }
    names = {
        "mpjpe_root_aligned": "MPJPE, roots aligned",
        "mpjpe": "MPJPE",
        "root_drift": "drift",
        "foot_skate": "foot skate",
    }
    table = [
        "| planner | " + " | ".join(names.get(key, key) for key in FIGURES) + " | resets | fallen | steps a frame |",
        "| --- |" + " ---: |" * (len(FIGURES) + 3),
    ]
    for name, one in rows.items():
        ratios = " | ".join(f"{one['figures'][key] / one['regressor'][key]:.3f}" for key in FIGURES)
        table.append(f"| {name} | {ratios} | {one['resets']} | {one['fallen']} | {one['steps']:.0f} |")
    page = HERE / "README.md"
    before, rest = page.read_text().split("<!-- table -->")
    after = rest.split("<!-- end -->")[1]
    write_text_whole(page, f"{before}<!-- table -->\n" + "\n".join(table) + f"\n<!-- end -->{after}")


def raw(name: str) -> Path:
    return HERE / "raw" / f"{name.replace(',', '').replace(' ', '_')}.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="*")
    given = parser.parse_args()
    agent = load_agent(given.run, which="latest")
    fragments = drawn(agent.dataset.train, given.frames, given.seed)
    agent = replace(agent, dataset=replace(agent.dataset, train=fragments))
    for name, overrides in read_yaml(HERE / "trial.yaml", "rows").items():
        if raw(name).is_file() or not fnmatch.fnmatch(name, given.only):
            continue
        result = figures(row(agent, fragments, overrides))
        planner = read_planner(compose_config("evaluate", ["checkpoint=none", *overrides])["planner"])
        steps = 0.0 if planner is None else planner.control_steps
        about = {"settings": overrides, "run": given.run.name, "seed": given.seed, "steps": steps}
        raw(name).parent.mkdir(exist_ok=True)
        write_text_whole(raw(name), json.dumps({**about, **result}, indent=1) + "\n")
        print(name, result, flush=True)
    write_table()


if __name__ == "__main__":
    main()
