"""Actor and critic: the start policy, exploration, PPO's gradients, what the settings refuse."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from helpers.mocap import default_humanoid
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from egopose.core.errors import InputError
from egopose.models.feedback import BalanceFeedback
from egopose.models.policy import PolicySettings, build_actor, build_critic

CONF = Path(__file__).resolve().parents[2] / "conf" / "model"
WIDTHS = {"humanoid_state": 115, "visual_context": 128, "reference_state": 115, "tracking_error": 230}
HINGES = [f"{joint.name}_{k}" for joint in default_humanoid().skeleton.joints for k in range(len(joint.dofs))]
BOUNDS = torch.tensor([[0, 300], [300, 800]])


def config(name: str) -> dict[str, Any]:
    return yaml.safe_load((CONF / f"{name}.yaml").read_text())


def build(name: str, **changes: Any) -> tuple[Any, Any]:
    torch.manual_seed(0)
    settings = PolicySettings.from_config({**config(name), **changes})
    store = (torch.randn(800, 128), BOUNDS) if settings.context.source == "trainable" else (None, None)
    return build_actor(settings, WIDTHS, 52, *store, dof_names=HINGES), build_critic(settings, WIDTHS, *store)


def observations(*batch: int) -> TensorDict:
    td = TensorDict({k: torch.randn(*batch, w) for k, w in WIDTHS.items()}, batch)
    td["episode_start"] = torch.randint(0, 700, (*batch, 1)) // 100 * 100
    td["frame"] = td["episode_start"] + torch.randint(0, 90, (*batch, 1))
    return td


@pytest.mark.parametrize("name", ["paper", "fast"])
def test_start_policy_is_the_action_reference(name: str) -> None:
    actor, critic = build(name)
    td = observations(6)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        out = critic(actor(td))
    assert out["action"].shape == (6, 52)
    assert out["state_value"].shape == (6, 1)
    torch.testing.assert_close(out["action"], out["loc"])
    assert out["loc"].abs().max() < 0.05
    assert not torch.equal(out["loc"][0], out["loc"][1])


@pytest.mark.parametrize("name", ["paper", "fast"])
def test_exploration_has_the_sigma_of_the_config(name: str) -> None:
    actor, _ = build(name)
    td = observations(1).expand(4000).clone()
    with torch.no_grad():
        out = actor(td)
    sigma = config(name)["sigma"]
    assert ((out["action"] - out["loc"]).std(0) / sigma - 1).abs().max() < 0.1
    z = (out["action"] - out["loc"]) / sigma
    expected = -0.5 * (z**2).sum(-1) - 52 * (math.log(sigma) + 0.5 * math.log(2 * math.pi))
    torch.testing.assert_close(out["action_log_prob"], expected, atol=2e-3, rtol=1e-4)


def test_sigma_is_a_parameter_only_where_it_is_learned() -> None:
    names = {learn: dict(build("fast", learn_sigma=learn)[0].named_parameters()) for learn in (True, False)}
    assert any("log_sigma" in n for n in names[True])
    assert not any("log_sigma" in n for n in names[False])


@pytest.mark.parametrize("name", ["paper", "fast"])
def test_ppo_reaches_every_parameter(name: str) -> None:
    actor, critic = build(name)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_bonus=False)
    advantage = GAE(gamma=0.95, lmbda=0.95, value_network=critic, shifted=False, deactivate_vmap=True)
    td = observations(4, 8)
    td["episode_start"] = td["episode_start"][:, :1].expand(4, 8, 1).clone()
    td["frame"] = td["episode_start"] + torch.arange(8)[None, :, None]
    with torch.no_grad():
        td = actor(td)
    td["next"] = observations(4, 8).select(*WIDTHS)
    td["next", "episode_start"], td["next", "frame"] = td["episode_start"], td["frame"] + 1
    td["next", "reward"] = torch.randn(4, 8, 1)
    for key in ("done", "terminated"):
        td["next", key] = torch.zeros(4, 8, 1, dtype=torch.bool)
    with torch.no_grad():
        td = advantage(td)
    losses = loss(td.reshape(-1))
    (losses["loss_objective"] + losses["loss_critic"]).backward()
    for module in (actor, critic):
        for key, parameter in module.named_parameters():
            assert parameter.grad is not None, key
            assert parameter.grad.abs().sum() > 0, key
    # The collecting policy follows the optimiser: no stale cached context.
    before = actor(td.clone())["loc"].detach()
    torch.optim.Adam(loss.parameters(), 1e-2).step()
    with torch.no_grad():
        cached = actor(td.clone())["loc"]
    assert not torch.equal(before, cached)
    torch.testing.assert_close(cached, actor(td.clone())["loc"].detach(), atol=1e-5, rtol=1e-4)


def test_privileged_critic_reads_the_reference_and_the_actor_does_not() -> None:
    critic_settings = {"hidden": [300, 200], "privileged": ["reference_state"]}
    actor, critic = build("fast", critic=critic_settings)
    assert "reference_state" in critic.in_keys
    assert "reference_state" not in actor.in_keys
    td = observations(3)
    changed = td.clone().set("reference_state", td["reference_state"] + 1)
    assert not torch.equal(critic(td)["state_value"], critic(changed)["state_value"])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"sigma": 0.0}, "sigma"),
        ({"activation": "softplus"}, "activation"),
        ({"depth": 3}, "depth"),
        ({"context": {"source": "seen", "hidden_size": 1, "horizon": 1, "padding": 1}}, "context.source"),
        ({"critic": {"hidden": [3]}}, "privileged"),
        ({"critic": {"hidden": [3], "privileged": ["wind"]}}, "critic.privileged"),
        ({"inputs": ["tracking_error", "wind"]}, "inputs"),
        ({"inputs": []}, "feedback"),
        ({"feedback": {"pitch": [], "roll": []}}, "speed"),
        ({"feedback": {"pitch": [["RightFoot_0"], ["Tail_0"]], "roll": [], "speed": 1.0}}, "feedback.pitch"),
        ({"feedback": {"pitch": [], "roll": [["Tail_0"]], "speed": 1.0}}, "feedback.roll"),
    ],
)
def test_wrong_settings_are_named(change: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as error:
        build("fast", **change)
    assert error.value.field == field


@pytest.mark.parametrize("inputs", [["tracking_error"], ["reference_state", "tracking_error"]])
def test_feedback_adds_to_the_mean_what_it_reads_off_the_tracking_error(inputs: list[str]) -> None:
    actor, _ = build("fast", inputs=inputs)
    (feedback,) = (m for m in actor.modules() if isinstance(m, BalanceFeedback))
    td = observations(5)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        before = actor(td.clone())["action"]
        feedback.gains.normal_()
        after = actor(td.clone())["action"]
        added = feedback(td["tracking_error"])
    assert added.abs().max() > 0.1
    torch.testing.assert_close(after - before, added, atol=1e-5, rtol=1e-5)


def test_without_feedback_there_is_none() -> None:
    actor, critic = build("paper")
    assert not any(isinstance(m, BalanceFeedback) for m in (*actor.modules(), *critic.modules()))
    assert "tracking_error" not in (*actor.in_keys, *critic.in_keys)


def test_trainable_context_needs_the_features() -> None:
    settings = PolicySettings.from_config(config("paper"))
    with pytest.raises(InputError, match="visual features"):
        build_actor(settings, WIDTHS, 52)


def test_features_stay_out_of_the_weights() -> None:
    actor, _ = build("paper")
    assert max(v.numel() for v in actor.state_dict().values()) < 800 * 128
