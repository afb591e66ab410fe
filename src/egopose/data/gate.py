"""The physics gate: can the simulated body follow a reference clip at all, before anything is learned?

``python -m egopose.data.gate [data=cmu6 data.folder=PATH sim=fast ...] [--json] [--workers N]`` measures every clip of
a data set. A clip whose soles float or sink, or whose joints the limits hold back, fails here at once, where a policy
would take hours to show it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.runtime import end_with_parent
from egopose.data.feasibility import contact_residual
from egopose.data.prepare_motion import PreparationSettings, reference_motion
from egopose.data.reference import reference_states, supported
from egopose.data.source_reading import read_source
from egopose.data.take_sources import TakeSource, find_sources
from egopose.humanoid.config import HumanoidConfig, SimConfig
from egopose.humanoid.foot_geometry import lowest_points
from egopose.humanoid.model import HumanoidModel, build_humanoid
from egopose.humanoid.physics import BatchedPhysics
from egopose.motion import rotations as rot
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array

#: Control steps driven from every start, every how many frames a start, and seconds of reference velocity added to the
#: target: PD with kd = 0.1 kp lags by 0.1 s of it, and 0.06 s follows best over the first steps.
STEPS, STRIDE, LEAD = 3, 3, 0.06
#: Body weights that contact may fall short of what the motion needs in a frame that is started from or driven to.
LARGEST_RESIDUAL = 0.25
#: A clip passes at or below this mean height error (m) and above this mean root reward.
LARGEST_HEIGHT_ERROR, LEAST_ROOT_REWARD = 0.01, 0.85


@dataclass(frozen=True)
class GateResult:
    """What open-loop PD makes of one clip.

    Args:
        starts: how many; 0 for a clip too short, or nowhere on the floor.
        supported: share of the clip's frames a body on a bare floor could be in.
        feasible: share of the clip's frames that are supported and that contact with the floor can have made.
        height_error: ``[STEPS]`` mean over starts of the root's ``|height - reference|``, m.
        height_bias: ``[STEPS]`` the same with its sign: below zero the body sinks.
        root_reward: ``[STEPS]`` mean over starts of r_p.
    """

    starts: int
    supported: float
    feasible: float
    height_error: tuple[float, ...]
    height_bias: tuple[float, ...]
    root_reward: tuple[float, ...]

    @property
    def mean_height_error(self) -> float:
        """m, over starts and steps."""
        return float(np.mean(self.height_error))

    @property
    def mean_root_reward(self) -> float:
        """Over starts and steps."""
        return float(np.mean(self.root_reward))

    @property
    def cause(self) -> str:
        """Why the clip cannot be followed; empty where it can."""
        if not self.starts:
            return (
                f"no start: a body on a bare floor could be in {self.supported:.0%} of the frames, and contact with it "
                f"can have made {self.feasible:.0%}"
            )
        causes = []
        if not self.mean_height_error <= LARGEST_HEIGHT_ERROR:
            error, bias = 100 * self.mean_height_error, 100 * float(np.mean(self.height_bias))
            causes.append(
                f"the root is {error:.2f} cm off in height ({bias:+.2f}), over {100 * LARGEST_HEIGHT_ERROR:g}"
            )
        if not self.mean_root_reward > LEAST_ROOT_REWARD:
            causes.append(f"the root's reward is {self.mean_root_reward:.3f}, not over {LEAST_ROOT_REWARD:g}")
        return "; ".join(causes)

    @property
    def passed(self) -> bool:
        """Whether the clip can be followed; one without a start cannot."""
        return not self.cause


def open_loop_gate(humanoid: HumanoidModel, clip: Motion, threads: int = 1, *, every_start: bool = False) -> GateResult:
    """Start on every third feasible frame, drive by PD for three control steps, compare the root.

    Feasible is a frame that :func:`egopose.data.reference.supported` finds on the floor or in flight, and whose
    :func:`egopose.data.feasibility.contact_residual` is below a quarter of the body's weight: a clip is judged by
    whether the body can follow what a body could have done. That is the motion's own inverse dynamics; no controller
    has a say in it.

    The target of each step is the reference's joint angles at the frame to be reached plus 0.06 s of its joint
    velocities there. The root's reward is r_p = exp(-300 dh^2 - 75 theta^2), theta the true angle between the roots
    (Yuan & Kitani 2019, eq. 8, with the half angle their program takes).

    Args:
        humanoid: at the simulation rate to be judged.
        clip: a reference clip of :func:`egopose.data.prepare_motion.reference_motion`.
        threads: of the physics; the result does not depend on it.
        every_start: start on supported frames that contact cannot have made too.

    Raises:
        ValueError: the clip is not on this humanoid at its control rate, or has no contacts.
    """
    if clip.contacts is None:
        raise ValueError("the clip has no contacts; make it with reference_motion")
    states = reference_states(humanoid, clip)
    qpos, qvel = states["qpos"].numpy(), states["qvel"].numpy()
    on_floor, feasible = _frames(humanoid, clip, states)
    starts = _starts(on_floor if every_start else feasible)
    if not len(starts):
        nothing = (float("nan"),) * STEPS
        return GateResult(0, float(on_floor.mean()), float(feasible.mean()), nothing, nothing, nothing)
    physics = BatchedPhysics(humanoid.mj_model, len(starts), humanoid.substeps, threads, body_ids=humanoid.body_ids)
    physics.set_state(np.arange(len(starts)), qpos[starts], qvel[starts])
    height, reward = np.empty((STEPS, len(starts))), np.empty((STEPS, len(starts)))
    for k in range(STEPS):
        frames = starts + k + 1
        physics.step(np.ascontiguousarray(qpos[frames, 7:] + LEAD * qvel[frames, 6:]))
        height[k] = physics.qpos[:, 2] - qpos[frames, 2]
        reward[k] = root_reward(physics.qpos, qpos[frames])
    physics.close()
    return GateResult(
        len(starts),
        float(on_floor.mean()),
        float(feasible.mean()),
        tuple(np.abs(height).mean(axis=1).tolist()),
        tuple(height.mean(axis=1).tolist()),
        tuple(reward.mean(axis=1).tolist()),
    )


def feasible_starts(humanoid: HumanoidModel, clip: Motion) -> NDArray[np.int64]:
    """Frames ``[S]`` :func:`open_loop_gate` starts from. Raises ValueError as it does."""
    if clip.contacts is None:
        raise ValueError("the clip has no contacts; make it with reference_motion")
    return _starts(_frames(humanoid, clip, reference_states(humanoid, clip))[1])


def _frames(humanoid: HumanoidModel, clip: Motion, states: TensorDict) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Frames ``[T]`` on the floor or in flight, and those among them that contact can have made."""
    assert clip.contacts is not None
    on_floor = supported(humanoid, states, clip.contacts, clip.fps, lowest_points(humanoid, clip))
    return on_floor, on_floor & (contact_residual(humanoid, clip) < LARGEST_RESIDUAL)


def _starts(good: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.array([s for s in range(0, len(good) - STEPS - 1, STRIDE) if good[s : s + STEPS + 1].all()], dtype=int)


def root_reward(qpos: Array, reference: Array) -> Array:
    """r_p ``[N]`` of ``qpos [N, nq]``."""
    off = rot.to_rotvec(rot.multiply(rot.conjugate(reference[:, 3:7]), qpos[:, 3:7]))
    return np.exp(-300.0 * (qpos[:, 2] - reference[:, 2]) ** 2 - 75.0 * np.sum(off**2, axis=1))


def gate_sources(
    config: Mapping[str, Any], workers: int = 1, *, every_start: bool = False
) -> Iterator[tuple[str, GateResult | InputError]]:
    """Name and result of every clip of a configuration's data set, in order; of a refused clip the cause.

    Args:
        config: resolved; groups ``data humanoid sim``.
        workers: processes.
        every_start: see :func:`open_loop_gate`.

    Raises:
        InputError: a source cannot be used, and ``data.on_refused`` is not ``skip``.
    """
    sources = find_sources(config["data"])
    work = partial(_gate_source, json.dumps(config, default=str), every_start)
    if workers == 1:
        yield from zip((s.name for s in sources), map(work, sources), strict=True)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=end_with_parent) as pool:
        yield from zip((s.name for s in sources), pool.map(work, sources), strict=True)


@lru_cache(maxsize=1)
def _parts(text: str) -> tuple[HumanoidModel, PreparationSettings, str]:
    config = json.loads(text)
    humanoid = build_humanoid(HumanoidConfig.from_mapping(config["humanoid"]), SimConfig(**config["sim"]))
    preparation = PreparationSettings.from_mapping(config["data"].get("preparation") or {})
    return humanoid, preparation, str(config["data"].get("on_refused", "stop"))


def _gate_source(config: str, every_start: bool, source: TakeSource) -> GateResult | InputError:
    humanoid, settings, on_refused = _parts(config)
    try:
        clip, _ = reference_motion(read_source(source), humanoid, settings, source.mapping)
    except InputError as error:
        if on_refused != "skip":
            raise
        return error
    return open_loop_gate(humanoid, clip, every_start=every_start)


HEADER = (
    "| clip | starts | on floor | feasible | height error, cm (bias) | root reward r_p | |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)


def row(name: str, result: GateResult | InputError) -> str:
    """One line of a Markdown table."""
    if isinstance(result, InputError):
        return f"| {name} | | | | | | refused: {result.field}: {result.cause} |"
    errors = ", ".join(
        f"{100 * e:.2f} ({100 * b:+.2f})" for e, b in zip(result.height_error, result.height_bias, strict=True)
    )
    rewards = ", ".join(f"{r:.3f}" for r in result.root_reward)
    return (
        f"| {name} | {result.starts} | {result.supported:.0%} | {result.feasible:.0%} "
        f"| {errors}: mean {100 * result.mean_height_error:.2f} "
        f"| {rewards}: mean {result.mean_root_reward:.3f} | {'' if result.passed else 'fails'} |"
    )


def _json(name: str, result: GateResult | InputError) -> str:
    refused = isinstance(result, InputError)
    return json.dumps({"clip": name} | ({"refused": str(result)} if refused else vars(result)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="egopose.data.gate", description="Open-loop PD on every clip of a data set.")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="of the configuration, as for prepare")
    parser.add_argument("--json", action="store_true", help="a JSON object a clip, one a line")
    parser.add_argument("--every-start", action="store_true", help="also from frames no contact can have made")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    options = parser.parse_intermixed_args(arguments)
    try:
        config = compose_config("prepare", options.overrides)
        results = []
        if not options.json:
            print(HEADER)
        for name, result in gate_sources(config, options.workers, every_start=options.every_start):
            results.append(result)
            print(_json(name, result) if options.json else row(name, result), flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if not options.json:
        passed = sum(isinstance(r, GateResult) and r.passed for r in results)
        print(f"\n{passed} of {len(results)} clips pass (sim: {config['sim']['substeps']} substeps)")


if __name__ == "__main__":
    main()
