"""python experiments/reconstruction_policy/grid.py RUN OUT.json: what a policy earns among boxes that stand elsewhere.

For a clip with two free scene parameters. Each world of a grid over e acts out the clip by the mean action. Beside what
it earned stands what the value network says of it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from egopose.envs.starts import Piece
from egopose.envs.test_time import prepare_for_test
from egopose.inference.scene_values import window_value
from egopose.pipeline.agent import load_agent
from egopose.tasks.reconstruction import ranges_of

SIDE = 9


@torch.no_grad()
def main(run: str, out: Path) -> None:
    agent = load_agent(run, which="latest")
    ranges, gamma = ranges_of(agent.dataset.clip.scene), float(agent.config["algo"]["gamma"])
    side = torch.linspace(-1, 1, SIDE, dtype=torch.float64)
    grid = torch.cartesian_prod(side, side)
    piece = Piece(0, 0, agent.dataset.train[0].stop)
    env = agent.make_env(num_envs=len(grid), whole_fragments=True, falls_end=True, fragments=[piece])
    env.base_env.problem.boxes = lambda frame, generator: ranges.scene(ranges.change_of(grid))
    prepare_for_test(env, agent.actor, agent.critic)
    seen = env.reset()
    value = agent.critic(seen.clone())["state_value"].squeeze(-1)
    earned, frames, up = torch.zeros(len(grid)), torch.zeros(len(grid)), torch.ones(len(grid), dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for t in range(piece.stop - 1):
            after = env.step(agent.actor(seen))["next"]
            earned += up * gamma**t * after["reward"].squeeze(-1)
            up &= ~after["terminated"].squeeze(-1)
            frames += up
            seen = after.exclude("reward", "action")
    window = window_value(agent, ranges, 0, None)
    fitted = torch.stack([window(e) for e in grid])
    told = {"earned": earned, "frames": frames, "value": value, "fitted": fitted}
    figures = {name: np.round(table.reshape(SIDE, SIDE).numpy(), 2).tolist() for name, table in told.items()}
    best = {name: grid[int(table.argmax())].tolist() for name, table in told.items()}
    alike = float(np.corrcoef(earned, fitted)[0, 1])
    out.write_text(json.dumps({"e": side.tolist(), "best": best, "correlation": alike, **figures}, indent=1))
    print(f"best e: {best}; earned and fitted correlate by {alike:.2f}")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
