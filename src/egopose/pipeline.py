"""From the resolved configuration to the objects it names; the one place where the rooms meet.

The way of training: store of takes -> state regressor's tables -> environment -> networks -> PPO.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from egopose.config import compose_config
from egopose.data.preparation import store_folder, video_of
from egopose.data.store import TakeStore
from egopose.envs import build as envs
from egopose.envs.aids import Aids
from egopose.envs.forecasting import RecurrentStates, TimeLeft
from egopose.envs.futures import FollowFuture
from egopose.envs.mdp.observations import humanoid_state
from egopose.envs.starts import FragmentLike
from egopose.envs.transformed import TransformedEgoPoseEnv
from egopose.envs.transforms import RawState, StateNormalizer, TrackingError, VisualContext
from egopose.errors import InputError
from egopose.evaluation.report import TakeVideo
from egopose.evaluation.survival import frames_survived
from egopose.material import Material, load_material, motion_material, run_material, smoothed
from egopose.models.policy import PolicySettings, build_actor, build_critic
from egopose.models.recurrent import collecting_policy, hidden_keys
from egopose.motion_forecasts import with_futures
from egopose.runtime import settle_heap
from egopose.training.adversarial import AdversarialPPO, DiscriminatorSettings
from egopose.training.checkpoint import RunCheckpoint, find_checkpoint, read_json, require, verify
from egopose.training.collectors import CollectorSettings, build_collector, transform_state
from egopose.training.exploration import SigmaSchedule, sigma_buffers
from egopose.training.loop import Evaluation, LoopSettings, Run, interrupts_held
from egopose.training.ppo import PPO, PPOSettings

__all__ = [
    "Agent",
    "build_env",
    "build_evaluation",
    "build_networks",
    "build_run",
    "compose_config",
    "load_agent",
    "load_material",
    "motion_material",
    "run_material",
    "take_videos",
]

_STORE_GROUPS = {"data", "humanoid"}
_LOOP_IN_ALGO = ("iterations", "steps_per_iteration")
_LOOP_IN_TRAINING = ("total_steps", "max_seconds", "checkpoint_every", "keep_last", "evaluate_every")


def build_env(
    config: Mapping[str, Any],
    material: Material,
    split: str = "train",
    *,
    worlds: int,
    threads: int = 1,
    seed: int = 0,
    whole_fragments: bool = False,
    falls_end: bool | None = None,
    dump_dir: Path | None = None,
    fragments: Sequence[FragmentLike] | None = None,
    aids: Aids | None = None,
    workers: int = 1,
) -> TransformedEnv:
    """The environment with its transforms, as ``config`` says.

    Args:
        config: resolved.
        material: see :class:`Material`.
        split: ``train`` or ``test`` fragments.
        worlds: N.
        threads: of the physics.
        seed: of the starts.
        whole_fragments: each world runs its own fragment from end to end.
        falls_end: whether a fall ends an episode; None for what the task says.
        dump_dir: where diverged worlds leave their last states.
        fragments: in place of those of ``split``.
        aids: only for environments that a run collects in, ``workers`` of them.

    Raises:
        InputError: the configuration asks for a table the material lacks, lets a forecast see the future, or the rooms
            refuse it.
    """
    material = smoothed(material, float(config["task"]["action"].get("smoothing", 0.0)))
    task = dict(config["task"])
    forecasts = task.get("context") is not None
    if forecasts:
        _refuse_future(config)
    if falls_end is not None:
        task["termination"] = {**task["termination"], "enabled": falls_end}
    try:
        problem = envs.build_problem(
            material.humanoid,
            material.reference,
            material.takes,
            task,
            config["reward"],
            action_reference=material.joint_targets,
            futures=material.futures,
        )
        base = envs.build_env(
            problem,
            fragments or (material.train if split == "train" else material.test),
            worlds,
            task,
            threads=threads,
            seed=seed,
            whole_fragments=whole_fragments,
            dump_dir=dump_dir,
            aids=aids,
            workers=workers,
        )
    except (ValueError, TypeError) as error:
        raise error if isinstance(error, InputError) else InputError("configuration", "task", str(error)) from None
    transforms = [StateNormalizer(base.observation_spec["humanoid_state"].shape[-1])]
    if material.futures is not None:
        transforms.insert(0, _follow(config, material))
    elif config["model"]["context"]["source"] == "frozen":
        if material.visual_context is None:
            raise InputError("configuration", "model.context.source", "frozen needs a trained state regressor")
        transforms.insert(0, VisualContext(material.visual_context))
    if material.futures is None and "tracking_error" in config["model"]["inputs"]:
        if material.states is None:
            raise InputError("configuration", "model.inputs", "tracking_error needs a trained state regressor")
        if "tracking_error_clip" not in task:
            raise InputError("configuration", "task.tracking_error_clip", "is missing")
        scale = _state_scale(material, float(config["regressor"]["std_floor"]))
        clip = float(task["tracking_error_clip"])
        transforms.insert(0, TrackingError(material.states, material.takes.following(), scale, clip))
    if "discriminator" in config.get("algo", ()):
        transforms.insert(0, RawState())
    if forecasts:
        transforms.append(TimeLeft(int(task["horizon"]) - 1))
    if (memory := config["model"].get("memory")) is not None:
        keys = [key for owner in ("policy", "value") for key in hidden_keys(owner)]
        transforms.append(RecurrentStates(dict.fromkeys(keys, int(memory["hidden_size"]))))
    return TransformedEgoPoseEnv(base, *transforms)


def _follow(config: Mapping[str, Any], material: Material) -> FollowFuture:
    """What the policy sees of the forecasts it follows, as ``task.follow`` says."""
    assert material.futures is not None
    task, humanoid = config["task"], material.humanoid
    if not isinstance(task.get("follow"), Mapping):
        raise InputError("configuration", "task.follow", "is missing: a forecaster is for task=forecasting_follow")
    lag = torch.as_tensor(humanoid.kd / humanoid.kp) * float(task["follow"]["velocity_feedforward"])
    return FollowFuture(
        material.futures,
        _scale_of(humanoid_state(material.reference).float(), material, float(config["forecaster"]["std_floor"])),
        torch.as_tensor(humanoid.rest_action),
        lag,
        float(task["follow"]["error_clip"]),
        [int(step) for step in task["follow"]["ahead"]],
    )


def _refuse_future(config: Mapping[str, Any]) -> None:
    """Raises InputError: a forecasting policy would read what is known only once the future was seen."""
    task, model = config["task"], config["model"]
    if config.get("forecaster") is not None:  # these stand in the regressor's place, and know the context alone
        if task["action"]["reference"] != "rest" or model["context"]["source"] != "frozen":
            cause = "a forecaster is for task=forecasting_follow model=forecasting_follow"
            raise InputError("configuration", "forecaster", cause)
        return
    if task["action"]["reference"] == "regressor":
        raise InputError("configuration", "task.action.reference", "regressor knows the frames to be forecast")
    if "tracking_error" in model["inputs"]:
        raise InputError("configuration", "model.inputs", "tracking_error knows the frames to be forecast")
    context = model["context"]
    if context["source"] != "past" or int(context["horizon"]) > int(task["context"]):
        cause = f"a forecast sees the past {task['context']} frames only: model=forecasting"
        raise InputError("configuration", "model.context", cause)


def _state_scale(material: Material, floor: float) -> torch.Tensor:
    """``[S]``: deviation of the regressor's states on the training frames, floored for still numbers."""
    assert material.states is not None
    return _scale_of(material.states, material, floor)


def _scale_of(states: torch.Tensor, material: Material, floor: float) -> torch.Tensor:
    offsets = material.takes.offsets
    rows = [states[int(offsets[f.take]) + f.start : int(offsets[f.take]) + f.stop] for f in material.train]
    return torch.cat(rows).std(dim=0).clamp_min(floor)


def build_networks(
    config: Mapping[str, Any], material: Material, env: EnvBase
) -> tuple[TensorDictModuleBase, TensorDictModuleBase]:
    """Actor and critic for ``env``'s observations, their start drawn from torch's generator.

    Raises:
        InputError: ``config["model"]`` does not fit; names the setting.
    """
    settings = PolicySettings.from_config(config["model"])
    widths = {name: spec.shape[-1] for name, spec in env.observation_spec.items() if name != "reward_terms"}
    bounds = torch.stack([material.takes.offsets, material.takes.offsets + material.takes.lengths], dim=1)
    names = [f"{joint.name}_{k}" for joint in material.humanoid.skeleton.joints for k in range(len(joint.dofs))]
    actor = build_actor(settings, widths, env.action_spec.shape[-1], material.visual_features, bounds, dof_names=names)
    return actor, build_critic(settings, widths, material.visual_features, bounds)


def build_run(config: Mapping[str, Any], folder: Path, material: Material) -> Run:
    """The run ``config`` describes, not yet begun.

    Raises:
        InputError: a setting is missing, unknown or out of range.
    """
    algo, training = dict(config["algo"]), config["training"]
    loop = {name: algo.pop(name, ...) for name in _LOOP_IN_ALGO}
    loop |= {name: training.get(name, ...) for name in _LOOP_IN_TRAINING}
    settings = LoopSettings.from_config(loop)
    material.keep_regressor(folder)
    material.keep_provenance(folder)
    collector_settings = CollectorSettings.from_config(config["collector"])
    ppo_settings = PPOSettings.from_config(algo)

    for seed in (torch.manual_seed, random.seed, np.random.seed):
        seed(int(config["seed"]) % 2**32)
    probe = build_env(config, material, worlds=1)
    actor, critic = build_networks(config, material, probe)
    action_size = int(probe.action_spec.shape[-1])
    probe.close()
    sigma = _sigma_schedule(config, actor)
    with interrupts_held():
        collector = build_collector(
            collector_settings,
            partial(_training_env, config, material, collector_settings, folder),
            collecting_policy(actor, critic),
            settings.steps_per_iteration,
        )
    if "discriminator" in algo:
        ppo: PPO = _adversarial(config, material, actor, critic, ppo_settings)
    else:
        ppo = PPO(actor, critic, ppo_settings)
    settle_heap()
    return Run(ppo, collector, settings, collector_settings, folder, config, action_size, sigma)


def _sigma_schedule(config: Mapping[str, Any], actor: TensorDictModuleBase) -> SigmaSchedule | None:
    """As ``aids.sigma`` says, None for a sigma that stays."""
    settings = Aids.from_config(config.get("aids")).sigma
    if settings is None:
        return None
    if config["model"]["learn_sigma"]:
        raise InputError("configuration", "aids.sigma", "is for a fixed sigma, and model.learn_sigma is true")
    return SigmaSchedule(sigma_buffers(actor), settings.sigma, float(config["model"]["sigma"]), settings.steps)


def _adversarial(
    config: Mapping[str, Any],
    material: Material,
    actor: TensorDictModuleBase,
    critic: TensorDictModuleBase,
    settings: PPOSettings,
) -> AdversarialPPO:
    """VGAIL's learner: the discriminator's examples are the reference's states on the training frames."""
    if material.visual_context is None or config["model"]["context"]["source"] != "frozen":
        raise InputError("configuration", "model.context.source", "a discriminator needs frozen visual context")
    offsets = material.takes.offsets
    frames = torch.cat([torch.arange(f.start, f.stop) + offsets[f.take] for f in material.train])
    states = humanoid_state(material.reference[frames]).float()
    discriminator = DiscriminatorSettings.from_config(config["algo"]["discriminator"])
    contexts, floor = torch.as_tensor(material.visual_context[frames]), float(config["regressor"]["std_floor"])
    return AdversarialPPO(actor, critic, settings, discriminator, states, contexts, floor)


def _training_env(
    config: Mapping[str, Any], material: Material, settings: CollectorSettings, folder: Path, worker: int
) -> TransformedEnv:
    return build_env(
        config,
        material,
        worlds=settings.worlds,
        threads=settings.physics_threads,
        seed=int(config["seed"]) * 1000 + worker,
        dump_dir=folder / "diverged",
        aids=Aids.from_config(config.get("aids")),
        workers=1 if settings.kind == "sync" else settings.workers,
    )


def build_evaluation(run: Run, material: Material) -> Evaluation:
    """A look at the mean action while training: frames survived on the test fragments, from starts that stay the same.

    Its ``score`` is the mean number of frames survived.
    """
    config = run.config
    training = config["training"]
    env = build_env(
        config,
        material,
        "test",
        worlds=int(training["evaluation_worlds"]),
        threads=int(config["collector"]["physics_threads"]),
    )

    def evaluate(iteration: int) -> dict[str, float]:
        env.load_state_dict(transform_state(run.collector))
        survival = frames_survived(env, copy.deepcopy(run.ppo.actor), int(training["evaluation_seed"]))
        return {"score": survival.mean, "falls": float(survival.fell.double().mean())}

    return evaluate


@dataclass(frozen=True)
class Agent:
    """A trained policy and what it was trained on.

    Attributes:
        actor, critic: in evaluation mode.
        config: resolved, of its run.
        material: see :class:`Material`.
        make_env: ``make_env(split="test", worlds=1, ...)`` as :func:`build_env`, with the normaliser as trained and
            frozen.
        path: the checkpoint.
    """

    actor: TensorDictModuleBase
    critic: TensorDictModuleBase
    config: dict[str, Any]
    material: Material
    make_env: Callable[..., TransformedEnv]
    path: Path

    def followed_states(self) -> torch.Tensor:
        """``[F, S]`` humanoid states of the regressor as the policy follows them, smoothed as ``task.action`` says.

        Raises:
            InputError: there is no regressor.
        """
        states = smoothed(self.material, float(self.config["task"]["action"].get("smoothing", 0.0))).states
        if states is None:
            raise InputError(self.path, "regressor", "the policy starts from the state regressor, and there is none")
        return states


def load_agent(
    path: str | Path, material: Material | None = None, which: str = "best", overrides: Mapping[str, Any] | None = None
) -> Agent:
    """Networks and environment from a checkpoint.

    Args:
        path: a checkpoint folder or a run directory.
        material: to run on; None for the data its configuration names, seen by the run's own state regressor.
        which: of a run directory, the ``best`` or the ``latest`` checkpoint.
        overrides: whole config groups in place of the run's own (``{"data": {...}}``).

    Raises:
        InputError: the checkpoint is damaged, or does not fit the material; the run was trained on other data, or its
            state regressor is gone; names the field.
    """
    folder = find_checkpoint(path, which)
    metadata = verify(folder)
    own = read_json(folder, "config")
    config = {**own, **(overrides or {})}
    if material is None:
        same_store = not _other_store(own, config)
        material = run_material(config, folder.resolve().parent.parent, same_store)
    material = with_futures(config, material, folder.resolve().parent.parent)
    env = build_env(config, material, worlds=1)
    require(metadata, folder, task=str(config["task"]["name"]), action_size=int(env.action_spec.shape[-1]))
    actor, critic = build_networks(config, material, env)
    RunCheckpoint({"policy": actor, "critic": critic, "transforms": env}).restore(folder)
    statistics = copy.deepcopy(env.state_dict())
    env.close()

    def make_env(split: str = "test", *, worlds: int = 1, **options: Any) -> TransformedEnv:
        made = build_env(config, material, split, worlds=worlds, **options)
        made.load_state_dict(statistics)
        for module in made.transform.modules():
            if isinstance(module, StateNormalizer):
                module.freeze()
        return made

    return Agent(actor.eval(), critic.eval(), config, material, make_env, folder)


def _other_store(own: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
    """Whether ``config`` asks for other data than a run's own, and not for the same that lies elsewhere by now."""

    def parts(one: Mapping[str, Any]) -> list[Any]:
        place = dict.fromkeys(("folder", "store"))
        return [{**one[group], **place} if group == "data" else one[group] for group in sorted(_STORE_GROUPS)]

    return bool(parts(own) != parts(config))


def take_videos(config: Mapping[str, Any]) -> tuple[list[str], list[TakeVideo | None]]:
    """Names of all takes of a prepared configuration, and the wearer's video of each where its file is there.

    Raises:
        InputError: the data is not prepared.
    """
    store = TakeStore.open(store_folder(config))
    videos = [
        TakeVideo(path, take.sync_offset, take.rendered, (take.camera or {}).get("fps"))
        if (path := video_of(config, store, i)).is_file()
        else None
        for i, take in enumerate(store.takes)
    ]
    return [take.name for take in store.takes], videos
