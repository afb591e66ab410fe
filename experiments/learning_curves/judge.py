"""``python experiments/learning_curves/judge.py DATA_FOLDER NAME=CHECKPOINT ...``: policies on the same uniform starts.

On people never seen, by how wrong the target motion is: frames survived by the mean action, and falls a minute of them.
Adds to ``raw/judged.json`` and prints each policy's figures. ``NAME=zero`` is the zero action.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from egopose.checkpoint.checkpoint import RunCheckpoint
from egopose.core.config import compose_config
from egopose.pipeline.dataset import load_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.networks import build_networks
from egopose.training.survival import base_tracking, frames_survived

HERE = Path(__file__).parent
ERRORS = ("truth", "0.08 rad", "0.20 rad")
STARTS, SEED = 512, 1


def main() -> None:
    """The command."""
    folder, *words = sys.argv[1:]
    config = compose_config("train", ["experiment=tracking", f"data.folder={folder}"])
    config["task"]["starts"] = {"kind": "uniform"}
    dataset = load_dataset(config)
    pieces = len(dataset.test) // len(ERRORS)
    raw = HERE / "raw" / "judged.json"
    judged: dict[str, dict[str, dict[str, float]]] = json.loads(raw.read_text()) if raw.is_file() else {}
    for word in words:
        name, path = word.split("=", 1)
        judged[name] = {}
        for number, error in enumerate(ERRORS):
            part = dataset.test[number * pieces : (number + 1) * pieces]
            env = build_env(config, dataset, num_envs=STARTS, threads=2, fragments=part)
            actor, _ = build_networks(config, dataset, env)
            if path != "zero":
                RunCheckpoint({"policy": actor, "transforms": env}).restore(path, {"policy", "transforms"})
            survival = frames_survived(env, base_tracking(env) if path == "zero" else actor, SEED)
            fell = float(survival.fell.double().mean())
            falls = 1800.0 * fell / survival.mean
            judged[name][error] = {"frames": survival.mean, "fell": fell, "falls_per_minute": falls}
            env.close()
        print(
            name, {error: {k: round(v, 2) for k, v in row.items()} for error, row in judged[name].items()}, flush=True
        )
    raw.write_text(json.dumps(judged, indent=1) + "\n")


if __name__ == "__main__":
    main()
