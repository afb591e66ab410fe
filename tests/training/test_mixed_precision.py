"""PPO in bfloat16: what stays float32, how close its gradient is, and that runs from before it go on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from helpers.toy_problem import SETTINGS, make_env, make_run
from tensordict import TensorDictBase
from torch import Tensor, nn

from egopose.core.config import compose_config
from egopose.core.config_files import config_dir
from egopose.core.errors import InputError
from egopose.models import mixed_precision
from egopose.models.mixed_precision import MixedPrecisionMLP, bfloat16_products
from egopose.models.policy import PolicySettings, build_actor, build_critic
from egopose.training.loop import iterate
from egopose.training.ppo import PPO, PPOSettings

WIDTHS = {"humanoid_state": 4, "visual_context": 3}


def learner(autocast: str = "bfloat16", **settings: Any) -> PPO:
    """PPO with real networks, sized for the toy's observations and actions."""
    torch.manual_seed(0)
    model = yaml.safe_load((config_dir() / "model" / "fast.yaml").read_text())
    changes = {"hidden": [64, 32], "inputs": [], "feedback": None, "final_gain": 1.0}
    policy = PolicySettings.from_config({**model, **changes})
    actor, critic = build_actor(policy, WIDTHS, 2), build_critic(policy, WIDTHS)
    return PPO(actor, critic, PPOSettings.from_config({**SETTINGS, **settings, "autocast": autocast}))


def batch_of(ppo: PPO) -> TensorDictBase:
    torch.manual_seed(1)
    with torch.no_grad():
        return make_env().rollout(40, ppo.actor, break_when_any_done=False)


def gradient(ppo: PPO, rows: TensorDictBase) -> Tensor:
    losses, roughness = ppo._losses(rows)
    parameters = [*ppo.policy_parameters, *ppo.value_parameters]
    total = losses["loss_objective"] + losses["loss_critic"] + roughness
    return torch.cat([part.flatten() for part in torch.autograd.grad(total, parameters)])


def test_products_are_rounded_and_results_are_float32() -> None:
    torch.manual_seed(0)
    network = MixedPrecisionMLP(7, 2, num_cells=[16], activation_class=nn.ReLU)
    seen: list[torch.dtype] = []
    network[0].register_forward_hook(lambda _, __, out: seen.append(out.dtype))
    inputs = torch.randn(9, 4), torch.randn(9, 3)
    exact = network(*inputs)
    with bfloat16_products():
        rounded = network(*inputs)
    assert seen == [torch.float32, torch.bfloat16]
    assert rounded.dtype == torch.float32
    assert not torch.equal(rounded, exact)
    torch.testing.assert_close(rounded, exact, atol=0.02, rtol=0.02)  # eight bits
    assert torch.equal(network(*inputs), exact)  # and outside of it as before


def test_losses_stay_float32_and_finite() -> None:
    ppo = learner(smoothness=0.1)
    rows = ppo.advantages(batch_of(ppo))
    losses, roughness = ppo._losses(rows)
    for name, value in {**losses, "roughness": roughness}.items():
        assert value.dtype == torch.float32, name
        assert torch.isfinite(value).all(), name
    assert all(value.dtype == torch.float32 for value in rows.values())
    figures = ppo.update(rows)
    assert figures["skipped_minibatches"] == 0
    assert all(p.dtype == torch.float32 for p in [*ppo.policy_parameters, *ppo.value_parameters])


def test_the_ratio_begins_at_one() -> None:
    ppo = learner()
    batch = batch_of(ppo)
    collected = batch["action_log_prob"].flatten().clone()
    rows = ppo.advantages(batch)
    losses, _ = ppo._losses(rows)
    assert float(losses["max_ratio"]) == pytest.approx(1.0, abs=1e-5)
    assert ppo.divergence(rows) == pytest.approx(0.0, abs=1e-7)
    # Against what was collected in float32 it would not.
    rows["action_log_prob"] = collected
    losses, _ = ppo._losses(rows)
    assert float(losses["max_ratio"]) > 1.001


def test_the_gradient_points_where_float32s_does() -> None:
    half, full = learner("bfloat16"), learner("none")
    found = gradient(half, half.advantages(batch_of(half)))
    exact = gradient(full, full.advantages(batch_of(full)))
    assert not torch.equal(found, exact)
    assert torch.cosine_similarity(found, exact, dim=0) > 0.99
    assert float(found.norm() / exact.norm()) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("has", [True, False])
def test_auto_asks_the_processor(has: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": has}, raising=False)
    assert [learner(choice).in_bfloat16 for choice in ("auto", "bfloat16", "none")] == [has, True, False]


def test_a_torch_that_cannot_tell_means_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    assert not mixed_precision.has_bfloat16_products()


def test_the_papers_algorithm_is_float32_and_the_quick_one_asks() -> None:
    chosen = {
        name: compose_config("train", [f"algo={name}"])["algo"]["autocast"] for name in ("paper", "fast", "vgail")
    }
    assert chosen == {"paper": "none", "fast": "auto", "vgail": "auto"}


def test_another_word_is_refused() -> None:
    with pytest.raises(InputError, match="autocast: must be one of auto, bfloat16, none"):
        PPOSettings.from_config({**SETTINGS, "autocast": "float16"})


def test_a_run_from_before_the_setting_goes_on(tmp_path: Path) -> None:
    """Its settings lack the key, and its optimisers' states the switch of the fused step."""
    assert "autocast" not in SETTINGS
    run = make_run(tmp_path)
    assert not run.ppo.in_bfloat16
    iterate(run, iter(run.collector))
    for optimiser in (run.ppo.policy_optimizer, run.ppo.value_optimizer):
        former = torch.optim.Adam(optimiser.param_groups[0]["params"], lr=1e-3).state_dict()["param_groups"]
        optimiser.load_state_dict({**optimiser.state_dict(), "param_groups": former})
    figures = iterate(run, iter(run.collector))
    assert figures["skipped_minibatches"] == 0
