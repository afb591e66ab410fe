"""Steps/s on more cores than there are here, from the parts' measured cost: ``python experiments/scaling/simulate.py``.

Reads ``measured.json`` beside this file, which ``python -m egopose.bench scaling --json`` prints, and writes
``table.md`` and ``scaling.png`` there. See docs/scaling.md for the model.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).parent
NETWORK = 1.25e9  # bytes/s between machines: 10 Gbit/s Ethernet, assumed
MACHINE = 64  # cores a machine, assumed: beyond it batches cross the network
SHORTEST = 16  # steps of a piece: shorter ones leave GAE (lambda .95: a horizon of 20) nothing but the critic
ITERATIONS = 60
CORES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)


@dataclass(frozen=True)
class Plan:
    """How an iteration is divided: ``workers`` with ``num_envs`` each take ``steps`` batched steps."""

    workers: int
    num_envs: int
    steps: int

    @property
    def frames(self) -> int:
        return self.workers * self.num_envs * self.steps


def same_batch(cost: dict[str, Any], workers: int) -> Plan:
    """The configuration's own batch, however many workers share it, as long as pieces keep a useful length."""
    frames = cost["steps_per_iteration"]
    worlds = max(1, min(cost["num_envs"], frames // (workers * SHORTEST)))
    return Plan(workers, worlds, max(SHORTEST, round(frames / (workers * worlds))))


def growing_batch(cost: dict[str, Any], workers: int) -> Plan:
    """Every worker's worlds and 128 steps of each: the batch grows with the workers."""
    return Plan(workers, cost["num_envs"], 128)


def collect_seconds(cost: dict[str, Any], plan: Plan, rng: np.random.Generator, size: int) -> np.ndarray:
    """``[size]`` seconds that workers take for a piece. Steps of more worlds spread less, as sums do."""
    n = plan.num_envs
    step = cost["python_fixed_s"] + cost["policy_fixed_s"]
    step += n * (cost["physics_s"] + cost["python_world_s"] + cost["policy_world_s"])
    spread = cost["physics_cv"] * cost["physics_s"] * n * np.sqrt(32 / n * plan.steps)
    pack = plan.num_envs * plan.steps * cost["pack_s"] if plan.workers > MACHINE else 0.0
    return np.maximum(plan.steps * step + pack + spread * rng.standard_normal(size), 0.0)


def learner_parts(cost: dict[str, Any], plan: Plan, faster: float = 1.0) -> dict[str, float]:
    """Seconds of an iteration that one process spends on what comes from all workers."""
    frames, workers = plan.frames, plan.workers
    parts = {
        "transfer": frames * cost["join_s"] + workers * (cost["exchange_s"] + cost["weights_s"]),
        "update": frames * (cost["gae_s"] + cost["epochs"] * cost["update_s"]) / faster,
    }
    if workers > MACHINE:
        sent = frames * cost["frame_bytes"] + workers * (cost["exchange_bytes"] + cost["weights_bytes"])
        parts["transfer"] += frames * cost["unpack_s"] + sent / NETWORK
    return parts


def in_step(cost: dict[str, Any], plan: Plan, faster: float = 1.0) -> tuple[float, dict[str, float]]:
    """Steps/s and the share of each part where all wait for the slowest worker, then for the update."""
    rng = np.random.default_rng(0)
    slowest = [collect_seconds(cost, plan, rng, plan.workers).max() for _ in range(ITERATIONS)]
    parts = {"collect": float(np.mean(slowest)), **learner_parts(cost, plan, faster)}
    whole = sum(parts.values())
    return plan.frames / whole, {name: part / whole for name, part in parts.items()}


def curves(cost: dict[str, Any]) -> dict[str, list[tuple[int, Plan, float, dict[str, float]]]]:
    """Every way of dividing the work, over the number of cores."""
    out: dict[str, list[tuple[int, Plan, float, dict[str, float]]]] = {}
    for cores in CORES:
        ways = {
            "same batch": (same_batch(cost, cores), 1.0),
            "growing batch": (growing_batch(cost, cores), 1.0),
            "growing batch, update 20 times as quick": (growing_batch(cost, cores), 20.0),
        }
        for name, (plan, faster) in ways.items():
            rate, shares = in_step(cost, plan, faster)
            out.setdefault(name, []).append((cores, plan, rate, shares))
    return out


def check(cost: dict[str, Any]) -> list[str]:
    """Rows of predicted beside measured steps/s, here."""
    rows = []
    for name in sorted(key for key in cost if key.startswith("measured_")):
        kind, workers = name.removeprefix("measured_").rsplit("_", 1)
        plan = same_batch(cost, int(workers))
        if kind == "sync":  # nothing is sent
            alone = {**cost, "join_s": 0.0, "exchange_s": 0.0, "weights_s": 0.0}
            predicted, _ = in_step(alone, plan)
        else:
            predicted, _ = in_step(cost, plan)
        worked = cost[name.replace("measured", "worked")]
        figures = f"{predicted:,.0f} | {worked:,.0f} | {predicted / worked:.2f} | {cost[name]:,.0f}"
        rows.append(f"| {kind}, {workers} | {figures} |")
    return rows


def table(cost: dict[str, Any]) -> str:
    """The predictions and the check, as Markdown."""
    lines = ["Check on this machine (control steps/s of whole iterations):", ""]
    lines += ["| collector, workers | predicted | by processor time | predicted over it | by the wall's clock |"]
    lines += ["| --- | --- | --- | --- | --- |", *check(cost), ""]
    lines += ["Predictions:", ""]
    lines += ["| cores | way | worlds x steps a worker | batch | steps/s | collecting | transfer | update |"]
    lines += ["| --- | --- | --- | --- | --- | --- | --- | --- |"]
    for name, points in curves(cost).items():
        for cores, plan, rate, shares in points:
            if cores in (1, 2, 16, 64, 1024):
                parts = " | ".join(f"{shares[part]:.0%}" for part in ("collect", "transfer", "update"))
                size = f"{plan.num_envs} x {plan.steps} | {plan.frames:,}"
                lines.append(f"| {cores} | {name} | {size} | {rate:,.0f} | {parts} |")
    return "\n".join(lines) + "\n"


def plot(cost: dict[str, Any], path: Path) -> None:
    """Steps/s over cores, each way of dividing the work a line."""
    figure, axes = plt.subplots(figsize=(7, 4.5))
    result = curves(cost)
    for name, points in result.items():
        axes.plot([p[0] for p in points], [p[2] for p in points], marker=".", label=name)
    one = in_step(cost, growing_batch(cost, 1))[0]
    axes.plot(CORES, [one * cores for cores in CORES], "k:", label="as many times one core")
    axes.set(xscale="log", yscale="log", xlabel="cores", ylabel="control steps/s, update included")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--measured", type=Path, default=HERE / "measured.json")
    cost = json.loads(parser.parse_args().measured.read_text())
    text = table(cost)
    (HERE / "table.md").write_text(text)
    plot(cost, HERE / "scaling.png")
    print(text)


if __name__ == "__main__":
    main()
