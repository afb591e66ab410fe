"""Teaching a tracker by ``conf/tracker.yaml``: rounds of lessons and of learning, to a policy PPO can begin with."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from egopose.checkpoint.checkpoint import NOT_JUDGED, ComponentState, RunCheckpoint, metadata_of
from egopose.checkpoint.resume import differences, only_process
from egopose.collection.collectors import transform_state
from egopose.core.atomic_write import write_text_whole
from egopose.core.config import from_mapping
from egopose.core.errors import InputError
from egopose.core.safe_io import read_json
from egopose.core.torch_settings import torch_threads
from egopose.envs.imitation import ImitationProblem
from egopose.envs.starts import Piece
from egopose.envs.transforms import StateNormalizer
from egopose.humanoid.derivatives import Simulator
from egopose.humanoid.inverse_dynamics import ForceSettings
from egopose.humanoid.trajectory import TrackingCost
from egopose.models.policy import GaussianHead
from egopose.motion.io._npz import read_arrays
from egopose.motion.rotations import Array
from egopose.pipeline.dataset import absolute_paths, load_dataset
from egopose.pipeline.environment import build_env
from egopose.pipeline.run import build_run
from egopose.tasks.dataset import Dataset
from egopose.tasks.tracking import clips_of
from egopose.training.cloning import CloningSettings, LessonReader, clone
from egopose.training.loop import Run
from egopose.training.survival import base_tracking, frames_survived
from egopose.training.teacher import Lessons, Student, TeacherSettings, chunks, teach, teachers_motion

_SOURCE = "conf/tracker.yaml"
_OWN = ("out", "rounds", "shard", "seed", "teacher", "cloning")
_SIMULATED = 1024  # worlds of the teacher's simulator
_MAX_BYTES = 2**30  # of a file of lessons: eight times what conf/tracker.yaml makes


@dataclass(frozen=True)
class _Teaching:
    """What every round of one teaching shares."""

    values: Mapping[str, Any]
    run: Run
    dataset: Dataset
    problem: ImitationProblem
    teacher: TeacherSettings
    cloning: CloningSettings
    copies: int
    clips: int

    @property
    def out(self) -> Path:
        return Path(str(self.values["out"])).expanduser()

    def weights(self, number: int) -> Path:
        """Policy and normaliser after a round, as a checkpoint."""
        return self.out / f"round_{number}"

    def checkpoint(self) -> RunCheckpoint:
        """The components of :meth:`weights`, bound to the live objects."""
        env = self.run.collector.env
        transforms = ComponentState(env.state_dict, env.load_state_dict)
        return RunCheckpoint({"policy": self.run.ppo.actor, "transforms": transforms})

    @property
    def head(self) -> GaussianHead:
        """The policy's network."""
        heads = [module for module in self.run.ppo.actor.modules() if isinstance(module, GaussianHead)]
        return heads[0]

    @property
    def normalizer(self) -> StateNormalizer:
        env = self.run.collector.env
        found = [module for module in env.transform.modules() if isinstance(module, StateNormalizer)]
        return found[0]


def train_tracker(values: Mapping[str, Any]) -> None:
    """Run ``conf/tracker.yaml``, resolved. What is there already is not made again.

    Raises:
        InputError: a setting or the data cannot be used, or another process works in the folder.
    """
    out = Path(str(values["out"])).expanduser()
    with only_process(out):
        teaching = _prepared(values)
        try:
            lessons: list[Lessons] = []
            for number in range(int(values["rounds"])):
                # Of the policy as the round before left it, so that lessons that went missing are made as they were.
                lessons.append(_lessons(teaching, number))
                _round(teaching, number, lessons)
            print(f"policy: {teaching.weights(int(values['rounds']) - 1)}", flush=True)
        finally:
            teaching.run.collector.shutdown()


def _prepared(values: Mapping[str, Any]) -> _Teaching:
    teacher = dict(values["teacher"])
    teacher["cost"] = from_mapping(TrackingCost, teacher["cost"], f"{_SOURCE}: teacher.cost")
    teacher["forces"] = from_mapping(ForceSettings, teacher["forces"], f"{_SOURCE}: teacher.forces")
    settings = from_mapping(TeacherSettings, teacher, f"{_SOURCE}: teacher")
    cloning = from_mapping(CloningSettings, values["cloning"], f"{_SOURCE}: cloning")
    config = absolute_paths({key: value for key, value in values.items() if key not in (*_OWN, "experiment")})
    config["seed"] = values["seed"]
    if settings.every > settings.horizon:
        raise InputError(
            _SOURCE, "teacher.every", f"is {settings.every}: plans reach {settings.horizon} frames ahead (horizon)"
        )
    if config["training"]["start_from"] is not None:
        raise InputError(_SOURCE, "training.start_from", "is for PPO: a taught policy begins with its lessons")
    if config["task"]["name"] != "tracking":
        raise InputError(_SOURCE, "task", f"a teacher follows motion: task=tracking, not {config['task']['name']!r}")
    _keep_settings(Path(str(values["out"])).expanduser(), {**config, "teacher": values["teacher"]}, values["shard"])
    dataset = load_dataset(config)
    run = build_run(config, Path(str(values["out"])).expanduser() / "policy", dataset)
    problem = run.collector.env.base_env.problem
    sides = 1 + bool(config["task"]["mirror"])
    copies = len(config["task"]["errors"])
    return _Teaching(
        values, run, dataset, problem, settings, cloning, copies, len(dataset.takes.offsets) // (copies * sides)
    )


def _keep_settings(out: Path, config: Mapping[str, Any], shard: int) -> None:
    """Note in ``out/settings.json`` what the lessons depend on.

    Raises:
        InputError: the folder holds lessons of other settings.
    """
    settings = {name: config[name] for name in ("data", "humanoid", "sim", "task", "teacher", "seed")} | {
        "shard": shard
    }
    path = out / "settings.json"
    if not path.is_file():
        write_text_whole(path, json.dumps(settings, indent=1))
        return
    for field, before, now in differences(read_json(path, "settings"), json.loads(json.dumps(settings))):
        raise InputError(path, field, f"is {before!r} in this folder's lessons, not {now!r}: give another out=FOLDER")


def _round(teaching: _Teaching, number: int, lessons: list[Lessons]) -> None:
    """What the policy learns from the lessons of all rounds so far."""
    weights = teaching.weights(number)
    if weights.is_dir():
        teaching.checkpoint().restore(weights)
        return
    whole = Lessons.joined(lessons)
    dataset, task = teaching.dataset, teaching.run.config["task"]
    assert dataset.states is not None
    assert dataset.path is not None
    reader = LessonReader(
        whole,
        teaching.problem,
        dataset.states,
        dataset.path,
        dataset.takes.last(),
        tuple(int(frames) for frames in task["ahead"]),
        teaching.copies,
        bool(task["mirror"]),
        teaching.cloning,
        int(teaching.values["seed"]) + number,
    )
    if number == 0:
        _set_statistics(teaching, reader)

    def tell(step: int, error: float, seconds: float) -> None:
        print(f"round {number}, step {step}, error {error:.4f} rad, {seconds:.0f} s", file=sys.stderr, flush=True)

    threads = int(teaching.run.config["collector"]["update_threads"])
    with torch_threads(threads):
        clone(_Mean(teaching.head), teaching.normalizer.normalize, reader, teaching.cloning, tell)
    _judge(teaching, number)
    run = teaching.run
    teaching.checkpoint().save(weights, metadata=metadata_of(run.task, run.action_size, 0, 0, NOT_JUDGED))


class _Mean(nn.Module):
    """The mean of a Gaussian policy, in bfloat16 products where the processor has them."""

    def __init__(self, head: GaussianHead) -> None:
        super().__init__()
        self.head = head

    def forward(self, state: torch.Tensor, window: torch.Tensor) -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            mean: torch.Tensor = self.head(state, window)[0]
        return mean.float()


def _lessons(teaching: _Teaching, number: int) -> Lessons:
    """The lessons of a round, those that are missing made and kept in ``out/lessons_K``."""
    folder, values, dataset = teaching.out / f"lessons_{number}", teaching.values, teaching.dataset
    folder.mkdir(parents=True, exist_ok=True)
    own = [Piece(f.take, f.start, f.stop) for f in dataset.train if f.take < teaching.clips]
    pieces = chunks(own, dataset.takes.offsets.tolist(), teaching.teacher.chunk)
    if not pieces:
        raise InputError("configuration", "data", "no take has two frames to train on, so there is nothing to teach")
    order = np.random.default_rng([int(values["seed"]), number]).permutation(len(pieces))
    shards = np.array_split(order, max(1, len(pieces) // int(values["shard"])))
    files = [folder / f"{index:04d}.npz" for index in range(len(shards))]
    missing = [index for index, file in enumerate(files) if not file.is_file()]
    if missing:
        clips = clips_of(dataset)[: teaching.clips]
        motion = teachers_motion(dataset.humanoid, clips, teaching.teacher.forces)
        threads = int(teaching.run.config["collector"]["physics_threads"])
        simulator = Simulator(dataset.humanoid, _SIMULATED, threads)
        student = _student(teaching) if number else None
        for index in missing:
            rng = np.random.default_rng([int(values["seed"]), number, index])
            these = [pieces[piece] for piece in shards[index].tolist()]
            lessons, lost = teach(dataset.humanoid, motion, these, teaching.teacher, simulator, rng, student)
            part = files[index].with_suffix(".part.npz")
            np.savez(part, **{f.name: getattr(lessons, f.name) for f in fields(lessons)})
            os.replace(part, files[index])
            told = f"round {number}, lessons {index + 1} of {len(files)}: {len(lessons)}, bodies lost {lost}"
            print(told, file=sys.stderr, flush=True)
        simulator.close()
    model = dataset.humanoid.mj_model
    return Lessons.joined([_read(file, model.nq, model.nv, model.nu, dataset.reference.shape[0]) for file in files])


def _read(path: Path, nq: int, nv: int, nu: int, frames: int) -> Lessons:
    """Raises InputError: the file is no lessons, or those of another body or motion."""
    remedy = "remove it and give the command again"
    names = [f.name for f in fields(Lessons)]
    try:
        arrays = read_arrays(path, names, _MAX_BYTES, _MAX_BYTES // 2)
    except InputError as error:
        raise InputError(path, error.field, f"{error.cause}; {remedy}") from None
    if missing := [name for name in names if name not in arrays]:
        raise InputError(path, missing[0], f"is missing; {remedy}")
    count = len(arrays["frame"])
    shapes = {"frame": (), "qpos": (nq,), "qvel": (nv,), "ctrl": (nu,), "gains": (nu, 2 * nv)}
    for name, shape in shapes.items():
        if arrays[name].shape != (count, *shape):
            raise InputError(path, name, f"has shape {list(arrays[name].shape)}, not {[count, *shape]}; {remedy}")
    frame = arrays["frame"]
    if frame.dtype != np.int64 or (count and not 0 <= frame.min() <= frame.max() < frames):
        raise InputError(path, "frame", f"holds no frames of these {frames}; {remedy}")
    return Lessons(**arrays)


def _set_statistics(teaching: _Teaching, reader: LessonReader) -> None:
    """The normaliser's, as if it had seen a million states as those of the lessons."""
    states = torch.from_numpy(reader.draw(20_000)[0])
    normalizer, count = teaching.normalizer, 1_000_000
    normalizer.count.fill_(count)
    normalizer.mean.copy_(states.mean(0))
    normalizer.sum_of_squares.copy_((states.var(0) + 1e-6) * (count - 1))


def _student(teaching: _Teaching) -> Student:
    """The policy as it stands, as the teacher's student."""
    dataset, task, problem = teaching.dataset, teaching.run.config["task"], teaching.problem
    assert dataset.states is not None
    assert dataset.path is not None
    states, path, last = dataset.states, dataset.path, dataset.takes.last()
    ahead = tuple(int(frames) for frames in task["ahead"])
    # Sees the true motion, in the first copies.
    reader = LessonReader(
        None,
        problem,
        states,
        path,
        last,
        ahead,
        teaching.copies,
        bool(task["mirror"]),
        teaching.cloning,
        0,
    )
    mean = _Mean(teaching.head)

    @torch.no_grad()
    def act(frame: NDArray[np.int64], qpos: Array, qvel: Array) -> Array:
        state, window = reader.seen(frame, qpos, qvel)
        seen = teaching.normalizer.normalize(torch.from_numpy(state)).float()
        action = mean(seen, torch.from_numpy(window))
        return problem.target(action, torch.from_numpy(reader.next(frame))).numpy()

    return act


def _judge(teaching: _Teaching, number: int) -> None:
    """Frames survived by the policy's mean action and by the zero action, told."""
    config = teaching.run.config
    env = build_env(config, teaching.dataset, "test", num_envs=128, threads=int(config["collector"]["physics_threads"]))
    env.load_state_dict(transform_state(teaching.run.collector))
    for name, controller in (("policy", teaching.run.ppo.actor), ("zero action", base_tracking(env))):
        survival = frames_survived(env, controller, int(config["training"]["evaluation_seed"]))
        print(f"round {number}, held-out people: {name} survives {survival.mean:.1f} frames", flush=True)
    env.close()
