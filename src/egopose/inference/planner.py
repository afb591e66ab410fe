"""Looking ahead in the simulator: many candidates are simulated for some frames, and the body takes the best.

The body is simulated anyway, so an action can be tried before it is taken (predictive sampling: Howell et al. 2022,
arXiv 2212.00541; the policy's value at the horizon's end: Lowrey et al. 2019, POLO). A candidate is the policy's mean
action plus a smooth perturbation; the policy reacts in each. Chance alone rarely finds a candidate that is good in all
joints. So later rounds try candidates between and around the best ones (the cross-entropy method: Rubinstein 1999; in
control: Chua et al. 2018, PETS). Candidates are compared with the target motion: the state regressor's, or a kinematic
forecast. The true motion plays no part.

The paper's terms of reward are in each body's own heading frame: a turn or a step that was not made costs nothing once
it is past. Terms in the world (``heading``, ``path``) hold bodies to the path that is followed, see
:mod:`egopose.inference.followed_path`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace

import numpy as np
import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from egopose.collection.stepping import Entries, parts_of, run_parts
from egopose.core.errors import InputError
from egopose.envs.env import EgoPoseEnv
from egopose.envs.forecasting_transforms import RecurrentStates
from egopose.envs.mdp.rewards import build_reward
from egopose.envs.mdp.step_view import StepView
from egopose.envs.problem import Followed
from egopose.humanoid.physics import PER_WORLD, Array
from egopose.inference.candidates import Futures, Tried
from egopose.inference.followed_path import FollowedPath
from egopose.inference.planner_settings import PlannerSettings
from egopose.models.pose_regression import state_to_qpos

_EPISODE = ("take", "start", "stop", "frame")  # with one number for each body
_ROWS = ("placed", "laid", *(f"physics.{name}" for name in PER_WORLD))  # with more

_PARTS = (0.25, 0.5, 0.75)  # of the best candidate, tried in later rounds
_ELITES = (2, 4, 8)  # candidates whose means are tried
_NARROWED = 0.5  # of the perturbations' deviation, around the mean of the second of these
_BROKEN = 1000.0  # lost by a candidate whose physics break: more than any sum of rewards


class Planner:
    """Plans for N bodies side by side, each with ``samples`` copies that try candidates.

    Args:
        env: ``N * samples`` environments like those that are planned for. A fall does not end an episode, and the
            normaliser is frozen.
        actor, critic: policy and value network, in evaluation mode; sequences of modules that read and write plain
            entries.
        settings: see :class:`PlannerSettings`.
        followed: the target motion; None for the problem's own, of all frames.

    Attributes:
        path: the target motion's in the worlds of the bodies; None where it has none, and the reward's terms in the
            world are then left out.
        value: ``[N]`` return of the best candidate: discounted rewards and, at the horizon, V. It is 0 while the head
            is more than ``lost`` below its target, so that a fallen body is reset. Terms in the world are no part of
            it: a body that strayed is not lost.
        late: asked before each simulated step whether the time is up; never, unless it is set. The round under way is
            then given up. The best of the whole rounds is taken; without any, the plan so far goes on.
        plans: begun so far; ``plans_cut`` of them had fewer rounds than they should for want of time, and
            ``plans_missed`` had none.

    Raises:
        InputError: actions are torques, the policy has a memory, or no hinge is named.
    """

    def __init__(
        self,
        env: TransformedEnv,
        actor: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        settings: PlannerSettings,
        followed: Followed | None = None,
    ) -> None:
        base = env.base_env
        assert isinstance(base, EgoPoseEnv)
        problem, humanoid = base.problem, base.problem.humanoid
        if not problem.actions_move_targets:
            raise InputError(
                "planner", "action", "a planner moves targets of PD controllers, not torques: planner=none"
            )
        if any(isinstance(part, RecurrentStates) for part in env.transform):
            raise InputError("planner", "model.memory", "a planner's candidates begin without a memory: planner=none")
        self.settings, self._env, self._base = settings, env, base
        # Only the mean action is needed, so the distribution is left out.
        gaussian = isinstance(actor, ProbabilisticTensorDictSequential)
        self._actor = [part for step in (actor.module[:-1] if gaussian else [actor]) for part in parts_of(step)]
        self._action, self._critic = "loc" if gaussian else "action", parts_of(critic)
        states, self._row, path = problem.followed() if followed is None else followed
        table = build_reward(settings.reward)
        self._reward = table.part(set(table.names) - set(table.in_world)) if table.in_world else table
        along = [term for term in table.in_world if table.weights[term] > 0]
        self._path_reward = table.part(along) if along and path is not None else None
        self.path = None
        if path is not None:
            self.path = FollowedPath(path, humanoid.control_dt, settings.place_time, settings.heading_time)
        env.reset()
        self.follow(states)
        hinges = [joint.name for joint in humanoid.skeleton.joints for _ in joint.dofs]
        chosen = [float(any(part in name for part in settings.joints)) for name in hinges]
        if not any(chosen):
            raise InputError("planner", "joints", f"none of {', '.join(settings.joints)} is part of a hinge's name")
        self._deviation = settings.deviation * torch.tensor(chosen)
        self._generator = torch.Generator().manual_seed(settings.seed)
        worlds = base.batch_size[0] // settings.samples
        self._plan = torch.zeros(worlds, settings.horizon + settings.every, len(hinges))
        self._age = 0
        self._returns, self.value = torch.zeros(worlds), torch.zeros(worlds)
        self.late: Callable[[], bool] = lambda: False
        self.plans = self.plans_cut = self.plans_missed = 0

    def follow(self, states: Tensor) -> None:
        """Take ``states [R, S]`` for the target motion's; a live stream knows a few at a time.

        The bodies that the reward reads of stand at the origin and face along x: the heading frame does not depend on
        it.
        """
        humanoid, facing = self._base.problem.humanoid, np.array([1.0, 0.0, 0.0, 0.0])
        self._qpos, self._qvel = state_to_qpos(states.double().numpy(), np.zeros(2), facing, humanoid.joint_range)
        body = self._base.bodies(self._qpos, self._qvel)
        self._places: Array = body.xpos.numpy()
        self._followed = {name: getattr(body, name) for name in self._reward.reads}
        self._head_height = body.xpos[:, humanoid.head, 2]

    def perturbation(self, base: EgoPoseEnv) -> Tensor:
        """``[N, nu]`` to add to the policy's mean action in the present state of ``base`` (N environments).

        Called once a frame. Every ``every`` frames it plans anew, and at the next frame where there was no time for it.
        """
        row = self._row(base.observe())
        if self.path is not None:
            self.path.advance(row, base.body_state()["qpos"])
        if self._age % self.settings.every == 0:
            self.plans += 1
            if not self._look_ahead(base):
                self.plans_missed += 1
                self._age = -1
        self._age += 1
        head = torch.as_tensor(base.body_state()["xpos"])[:, base.problem.humanoid.head, 2]
        low = self._head_height[row] - head > self.settings.lost
        self.value = torch.where(low, 0.0, self._returns)
        now = self._plan[:, 0].clone()
        self._plan = self._plan.roll(-1, 1)
        self._plan[:, -1] = 0.0
        return now

    def forget(self, worlds: Tensor) -> None:
        """``worlds [n]`` were placed elsewhere: their plans are dropped, and all bodies plan anew."""
        self._plan[worlds], self._age = 0.0, 0

    def _perturbations(self, count: int, wider: float = 1.0) -> Tensor:
        """``[count, N, H, nu]`` new random perturbations, linear between their knots."""
        settings, (worlds, _, size) = self.settings, self._plan.shape
        knots = -(-(settings.horizon - 1) // settings.knot_spacing) + 1
        at_knots = torch.randn(count, worlds, knots, size, generator=self._generator) * (wider * self._deviation)
        at_knots *= 0.1 + 0.9 * torch.rand(count, worlds, 1, 1, generator=self._generator)
        time = torch.arange(settings.horizon) / settings.knot_spacing
        left = time.long().clamp(max=max(knots - 2, 0))
        share = (time - left)[:, None]
        return torch.lerp(at_knots[:, :, left], at_knots[:, :, (left + 1).clamp(max=knots - 1)], share)

    def _candidates(self) -> Tensor:
        """``[K, N, H, nu]``: no perturbation, the current plan, changes of it, and new ones."""
        candidates, plan = self._perturbations(self.settings.samples), self._plan[:, : self.settings.horizon]
        candidates[: self.settings.samples // 2] += plan
        candidates[0], candidates[1] = 0.0, plan
        return candidates

    def _refined(self, tried: Tried, wider: float = 1.0) -> Tensor:
        """``[K, N, H, nu]`` between and around the best of ``tried``.

        They are parts of the best one, parts of the way from the current plan to it, and means of the best ones. The
        rest are drawn around such a mean.
        """
        candidates, score = tried.candidates, tried.score
        best = candidates[
            score.topk(min(max(_ELITES), len(candidates)), dim=0).indices, torch.arange(candidates.shape[1])
        ]
        plan, means = candidates[1], [best[:count].mean(0) for count in _ELITES]
        result = [way for part in _PARTS for way in (torch.lerp(plan, best[0], part), part * best[0])]
        result += [way for mean in means for way in (mean, 0.5 * mean, torch.lerp(plan, mean, 0.5))]
        result = result[: self.settings.samples]
        about = means[1] + _NARROWED * self._perturbations(self.settings.samples - len(result), wider)
        return torch.cat([torch.stack(result), about])

    @torch.no_grad()
    def _look_ahead(self, base: EgoPoseEnv) -> bool:
        """Plan; whether there was time for a round."""
        now = base.state_dict()
        tried = self._searched(now)
        if tried is None:
            return False
        self._choose(tried)
        return True

    def _searched(self, now: Mapping[str, Tensor]) -> Tried | None:
        """What was tried from the bodies' state ``now``; None where there was no time for a round."""
        tried = self._tried(now, self._candidates())
        if tried is None:
            return None
        for _ in range(self.settings.rounds - 1):
            more = self._tried(now, self._refined(tried))
            if more is None:
                self.plans_cut += 1
                return tried
            tried = tried.joined(more)
        return self._rescued(now, tried)

    def _rescued(self, now: Mapping[str, Tensor], tried: Tried) -> Tried:
        """``tried``, and more rounds while a body falls, of larger perturbations: small ones catch no fall."""
        wide = self.settings.wider
        for number in range(self.settings.recovery_rounds):
            if not tried.falls(self.settings.height_drop):
                break
            wider = self._refined(tried, wide) if number % 2 else self._perturbations(self.settings.samples, wide)
            more = self._tried(now, wider)
            if more is None:
                self.plans_cut += 1
                break
            tried = tried.joined(more)
        return tried

    def _choose(self, tried: Tried) -> None:
        """Make the best candidate of each body its plan."""
        settings, candidates, score = self.settings, tried.candidates, tried.score
        worlds = torch.arange(candidates.shape[1])
        most, change = score.amax(0), (candidates - candidates[1]).square().mean((2, 3))
        best = torch.where(score >= most - settings.tie_tolerance, change, torch.inf).argmin(0)
        # Random search finds small gains in any noise. Following each of them makes the body tremble.
        enough = most - settings.margin
        best = torch.where(score[0] >= enough, 0, torch.where(score[1] >= enough, 1, best))
        self._returns = tried.returns[best, worlds]
        self._plan[:, : settings.horizon] = candidates[best, worlds]

    def _tried(self, now: Mapping[str, Tensor], candidates: Tensor) -> Tried | None:
        """``candidates [K, N, H, nu]`` from the bodies' state ``now``; None where :attr:`late` came between."""
        futures = self._simulated(now, candidates)
        return None if futures is None else self._scored(futures, candidates)

    def _simulated(self, now: Mapping[str, Tensor], candidates: Tensor) -> Futures | None:
        """What ``candidates [K, N, H, nu]``, at most ``samples`` of each body, do from the bodies' state ``now``."""
        steps, copies = self.settings.horizon, self._base
        count = candidates.shape[0] * candidates.shape[1]
        worlds = slice(0, count)
        self._copy(now)
        seen = Entries(self._env.transform(copies.observe(worlds)).items())
        qpos = np.empty((steps, count, copies.physics.model.nq))
        qvel = np.empty((steps + 1, count, copies.physics.model.nv))
        qvel[0] = copies.physics.qvel[worlds]
        rows, numbers, broken = [], [], torch.zeros(count)
        for step in range(steps):
            if self.late():
                return None
            run_parts(self._actor, seen)
            after = copies.try_step(seen[self._action] + candidates[:, :, step].flatten(0, 1), worlds)
            qpos[step], qvel[step + 1] = copies.physics.qpos[worlds], copies.physics.qvel[worlds]
            rows.append(self._row(after))
            numbers.append(after["episode_step"].squeeze(-1))
            broken += after["diverged"].squeeze(-1)
            seen = self._env.transform._step(seen, Entries(after))
        run_parts(self._critic, seen)
        return Futures(qpos, qvel, torch.cat(rows), torch.cat(numbers), broken, seen["state_value"].squeeze(-1))

    def _scored(self, futures: Futures, candidates: Tensor) -> Tried:
        """Score, returns and low heads of ``candidates [K, N, H, nu]``, which did ``futures``."""
        # Nothing of it changes what the candidates do: it is worked out for all steps at once.
        settings = self.settings
        reward, cost, low = self._judged(futures.qpos, futures.qvel, futures.row, futures.number)
        kept = settings.discount ** torch.arange(settings.horizon)
        returns = kept @ reward + settings.discount**settings.horizon * futures.value
        score = returns - kept @ cost - _BROKEN * futures.broken
        return Tried(candidates, *(part.unflatten(0, candidates.shape[:2]) for part in (score, returns, low[-1])))

    def _judged(self, qpos: Array, qvel: Array, row: Tensor, number: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reward in the heading frame, cost, and metres that the head is below its target, ``[H, M]`` float32.

        Args:
            qpos: ``[H, M, nq]`` after each step.
            qvel: ``[H + 1, M, nv]``, that before the first step too.
            row: ``[H * M]`` of the target motion.
            number: ``[H * M]`` steps into the episode.
        """
        settings, humanoid = self.settings, self._base.problem.humanoid
        shape = qpos.shape[:2]
        body = self._base.bodies(qpos.reshape(-1, qpos.shape[-1]), qvel[1:].reshape(-1, qvel.shape[-1]))
        followed = SimpleNamespace(**{name: rows.index_select(0, row) for name, rows in self._followed.items()})
        view = StepView(body, followed, number)
        reward, _ = self._reward(view)
        low = (self._head_height[row] - body.xpos[:, humanoid.head, 2]).clamp(min=0.0)
        changes = torch.from_numpy(np.abs(np.diff(qvel, axis=0)).mean(-1)).flatten() / humanoid.control_dt
        cost = settings.acceleration * changes + settings.head * low
        if self._path_reward is not None and self.path is not None:
            followed.place, followed.yaw = self.path.at(row)
            cost = cost - self._path_reward(view)[0]
        return reward.float().view(shape), cost.float().view(shape), low.float().view(shape)

    def _copy(self, state: Mapping[str, Tensor]) -> None:
        """Put the copies of every body into the body's state, taken from ``state`` of its environment."""
        samples = self.settings.samples
        own = self._base.state_dict()
        own |= {name: state[name].repeat(samples) for name in _EPISODE}
        rows = {name: state[name] for name in _ROWS if name in state}
        own |= {name: row.repeat(samples, *[1] * (row.ndim - 1)) for name, row in rows.items()}
        self._base.load_state_dict(own)

    def close(self) -> None:
        """Stop the copies' physics."""
        self._env.close()
