"""From a configuration to the kinematic forecasts a policy follows: trained once a run, kept in ``RUN_DIR/forecaster``.

Forecasts on training frames are cross-fitted, so the policy does not learn to over-trust them.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from egopose.data.windows import ForecastWindow
from egopose.humanoid.foot_geometry import out_of_floor
from egopose.models.placed_states import placed_states
from egopose.pipeline.agent import Agent
from egopose.pipeline.forecaster import ForecastCurves


def begin_forecasts(agent: Agent, windows: Sequence[ForecastWindow], pasts: Tensor) -> tuple[Tensor, Tensor]:
    """Where forecasts of ``windows`` begin: ``qpos [W, nq]`` and ``qvel [W, nv]``, placed where the reference is, feet
    out of the floor.

    That is the last state of ``pasts [W, context, S]``. If the agent follows kinematic forecasts, it is where those
    begin. From then on the agent follows, from these frames, forecasts made from ``pasts`` alone.
    """
    dataset = agent.dataset
    now = torch.tensor([int(dataset.takes.offsets[w.take]) + w.now for w in windows])
    where = torch.as_tensor(dataset.reference["qpos"][now]).double()
    humanoid = dataset.humanoid
    if dataset.forecasts is None:
        return placed_states(pasts[:, -1].numpy(), where.numpy(), humanoid)
    curves = ForecastCurves(agent.config, dataset, agent.path.resolve().parent.parent)
    dataset.forecasts.put(curves(pasts), now)
    qpos, qvel = dataset.forecasts.first_state(now, where, humanoid.joint_range)
    return torch.from_numpy(out_of_floor(humanoid, qpos.numpy())), qvel
