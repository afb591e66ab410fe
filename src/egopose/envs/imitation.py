"""One definition of the imitation problem, shared by the batched environment and the dm_control task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from egopose.envs.mdp import terminations
from egopose.envs.mdp.observations import BodyLayout, BodyState, BodyView, humanoid_state_rows
from egopose.envs.mdp.rewards import RewardTable
from egopose.envs.mdp.step_view import Contacts, StepView
from egopose.envs.problem import BODY_KEYS, Followed, Scene, TakeTable, TargetMotion
from egopose.envs.reference_forecasts import ReferenceForecasts
from egopose.envs.target_motion import CurveMotion, TableMotion
from egopose.humanoid.model import HumanoidModel
from egopose.humanoid.torques import torque_driven
from egopose.models.pose_regression import integrated_path


@dataclass(frozen=True)
class ActionSettings:
    """What an action is added to.

    Args:
        reference: ``rest``: the rest pose (the paper); ``regressor``: a table of joint targets, one row a frame;
            ``start``: the joint angles that the body was placed with by a reset or an estimated state.
        scale: of the action, rad per unit.
        velocity_feedforward: with ``regressor``, kd/kp times the table's joint velocity times this is added to the
            target, against the lag of a PD controller.
        smoothing: s, standard deviation in time of a Gaussian that smooths the regressor's joint targets, states and
            context. It reaches at most a third of a second to either side.
        kind: ``pd``: actions move the targets of PD controllers; ``torque``: they are torques, a unit being the joint's
            limit times ``scale``, and the other settings are not read.
        joint_damping: with ``torque``, see :func:`egopose.humanoid.torques.torque_driven`.
    """

    reference: str = "rest"
    scale: float = 1.0
    velocity_feedforward: float = 0.0
    smoothing: float = 0.0
    kind: str = "pd"
    joint_damping: float = 0.0

    def __post_init__(self) -> None:
        if self.reference not in ("rest", "regressor", "start"):
            raise ValueError(f"action.reference must be rest, regressor or start, not {self.reference!r}")
        if not 0.0 <= self.smoothing <= 1.0:
            raise ValueError(f"action.smoothing must lie in 0..1 s, not {self.smoothing}")
        if self.kind not in ("pd", "torque"):
            raise ValueError(f"action.kind must be pd or torque, not {self.kind!r}")


@dataclass(frozen=True)
class TerminationSettings:
    """When a fall ends the episode.

    Args:
        enabled: off in evaluation, where the fail-safe answers a fall.
        head_drop: m below the take's lowest reference head height.
    """

    enabled: bool = True
    head_drop: float = 0.1


class ImitationProblem:
    """A :class:`Problem` whose bodies imitate reference motion, frame by frame.

    Args:
        humanoid: the model.
        reference: TensorDict ``[F]`` of body states (float64), all takes one after the other.
        takes: where they lie.
        reward: see :class:`~egopose.envs.mdp.rewards.RewardTable`.
        action, termination: settings.
        action_reference: ``[F, nu]`` rad, the base target for reaching each frame; needed by ``regressor``.
        forecasts: kinematic forecasts that bodies follow: episodes begin in their first states in place of the
            reference's.
        states: ``[F, 2 nq - 3]`` humanoid states that bodies follow where there are no forecasts, or None.
        path: ``[F, 3]`` x, y (m) and heading (rad) of the root that they follow with the states; None for the path that
            the states' own velocities give.
        shows_path: observations hold the root in the path's axes.

    Raises:
        ValueError: the reference does not fit the humanoid, or the action's table or the path is missing or of another
            shape.
    """

    def __init__(
        self,
        humanoid: HumanoidModel,
        reference: TensorDictBase,
        takes: TakeTable,
        reward: RewardTable,
        action: ActionSettings,
        termination: TerminationSettings,
        action_reference: Tensor | None = None,
        forecasts: ReferenceForecasts | None = None,
        states: Tensor | None = None,
        path: Tensor | None = None,
        shows_path: bool = False,
    ) -> None:
        if action.kind == "torque":
            humanoid = torque_driven(humanoid, action.joint_damping)
        model = humanoid.mj_model
        if reference["qpos"].shape[1:] != (model.nq,) or reference["qvel"].shape[1:] != (model.nv,):
            raise ValueError(
                f"reference qpos and qvel have {reference['qpos'].shape[-1]} and {reference['qvel'].shape[-1]} "
                f"columns, the humanoid {model.nq} and {model.nv}"
            )
        if reference["xpos"].shape[1] != len(humanoid.body_ids):
            raise ValueError(
                f"reference has {reference['xpos'].shape[1]} bodies, the humanoid {len(humanoid.body_ids)}"
            )
        if path is not None and path.shape != (reference.shape[0], 3):
            raise ValueError(f"a path needs x, y and heading [{reference.shape[0]}, 3], got {list(path.shape)}")
        self.path = path
        self.humanoid, self.takes, self.reward = humanoid, takes, reward
        self.action, self.termination, self.forecasts, self.states = action, termination, forecasts, states
        self.observation_sizes: Mapping[str, int] = {"humanoid_state": 2 * model.nq - 3}
        self.endings: tuple[str, ...] = ("fallen",)
        self.ends_episode: frozenset[str] = frozenset(self.endings) if termination.enabled else frozenset()
        self.remembers_start = action.reference == "start"
        self.actions_move_targets = action.kind == "pd"
        self.watched: frozenset[str] = reward.needs
        self.memory_size = 0
        self.n_frames = reference.shape[0]
        self.reference = reference
        self.layout = BodyLayout(
            torch.as_tensor(humanoid.joint_parent, dtype=torch.int64),
            torch.as_tensor(humanoid.end_effectors, dtype=torch.int64),
        )
        # Plain tensors of what is looked up at every step or reset; what the reward reads of the reference is worked
        # out once.
        whole = BodyView(self.reference_at(torch.arange(self.n_frames)), self.layout)
        self._qpos, self._qvel = whole.qpos, whole.qvel
        self._rewarded = {name: getattr(whole, name).contiguous() for name in reward.reads}
        self.motion = self._motion()
        self.motion_seen: TargetMotion | None = self.motion if shows_path else None
        self._range = torch.as_tensor(humanoid.joint_range, dtype=torch.float64).T
        self._rest = torch.as_tensor(humanoid.rest_action, dtype=torch.float64)
        self._table: Tensor | None = None
        if action.reference == "regressor":
            if action_reference is None or action_reference.shape != (self.n_frames, model.nu):
                got = "none" if action_reference is None else list(action_reference.shape)
                raise ValueError(
                    f"action.reference=regressor needs joint targets [{self.n_frames}, {model.nu}], got {got}"
                )
            self.read_actions_from(action_reference)

    def read_actions_from(self, action_reference: Tensor) -> None:
        """Take ``[F, nu]`` rad for the joint angles that actions are added to. A live stream knows two at a time."""
        lag = torch.as_tensor(self.humanoid.kd / self.humanoid.kp) * self.action.velocity_feedforward
        table = torch.as_tensor(action_reference).to(torch.float64)
        self._table = table + lag * self._table_velocity(table)

    def _table_velocity(self, table: Tensor) -> Tensor:
        """``[F, nu]`` rad/s by which each frame is reached from the one before, within its take."""
        velocity = torch.zeros_like(table)
        velocity[1:] = table.diff(dim=0) / self.humanoid.control_dt
        for offset, length in zip(self.takes.offsets.tolist(), self.takes.lengths.tolist(), strict=True):
            velocity[offset] = velocity[offset + 1] if length > 1 else 0.0
        return velocity

    def reference_at(self, frame: Tensor) -> TensorDict:
        """Body states ``[N]`` of the reference at global frames ``[N]``."""
        return TensorDict(
            {k: torch.as_tensor(self.reference[k][frame]).to(torch.float64) for k in BODY_KEYS}, batch_size=frame.shape
        )

    def first_state(self, frame: Tensor, scene: Scene | None = None) -> tuple[Tensor, Tensor]:
        """``qpos [n, nq]`` and ``qvel [n, nv]`` of episodes that begin at global frames ``[n]``.

        The reference's, or where it stands and faces the state a forecast begins in.
        """
        if self.forecasts is not None:
            return self.forecasts.first_state(frame, self._qpos.index_select(0, frame), self._range.T.numpy())
        return self._qpos.index_select(0, frame), self._qvel.index_select(0, frame)

    def view(self, state: BodyState | BodyView) -> BodyView:
        """``state`` and what follows from it; the functions below take either, and share the work given a view."""
        return state if isinstance(state, BodyView) else BodyView(state, self.layout)

    def target(self, action: Tensor, frame: Tensor, placed: Tensor | None = None) -> Tensor:
        """PD targets ``[N, nu]`` rad from actions ``[N, nu]``, for reaching frames ``[N]``; within joint range.

        ``placed [N, nu]`` rad, the joint angles each body was placed with, is read by ``action.reference`` ``start``.

        With ``action.kind`` ``torque``: torques ``[N, nu]`` N m, within their limits.
        """
        if self.action.kind == "torque":
            share = torch.clamp(self.action.scale * action.to(torch.float64), -1.0, 1.0)
            return share * torch.as_tensor(self.humanoid.torque_limit)
        if self.action.reference == "start":
            if placed is None:
                raise ValueError("action.reference=start needs the joint angles the bodies were placed with")
            base = placed
        else:
            base = self._rest if self._table is None else self._table.index_select(0, frame)
        return torch.clamp(base + self.action.scale * action.to(torch.float64), self._range[0], self._range[1])

    def observation(self, state: BodyState | BodyView) -> Tensor:
        """The humanoid state ``[N, 115]``, float64; worked out on arrays (trace ``view(state).humanoid_state``)."""
        body = self.view(state)
        return torch.from_numpy(humanoid_state_rows(body.qpos.numpy(), body.qvel.numpy()))

    def observations(self, state: BodyState | BodyView, frame: Tensor) -> dict[str, Tensor]:
        """``humanoid_state [N, 115]``, see :meth:`observation`."""
        return {"humanoid_state": self.observation(state)}

    def step_view(
        self,
        state: BodyState | BodyView,
        frame: Tensor,
        step: Tensor,
        *,
        contacts: Contacts | None = None,
        torques: Tensor | None = None,
        target: Tensor | None = None,
        scene: Tensor | None = None,
    ) -> StepView:
        """What reward terms see of states at global frames ``[N]``, ``step [N]`` steps into the episode."""
        reference = SimpleNamespace(**{name: table.index_select(0, frame) for name, table in self._rewarded.items()})
        return StepView(self.view(state), reference, step, contacts, torques, target, scene)

    def rewards(self, view: StepView) -> tuple[Tensor, dict[str, Tensor]]:
        """Reward ``[N]`` of a step and its terms."""
        return self.reward(view)

    def ended(self, view: StepView, take: Tensor) -> dict[str, Tensor]:
        """``fallen [N]``: the head is too low for ``take [N]``, whether or not that ends the episode."""
        lowest = self.takes.lowest_head_height.index_select(0, take)
        head = view.body.xpos[:, self.humanoid.head, 2]
        return {"fallen": terminations.fallen(head, lowest, self.termination.head_drop)}

    def remembered(self, view: StepView, memory: Tensor) -> Tensor:
        """Nothing is kept."""
        return memory

    def boxes(self, frame: Tensor, generator: torch.Generator) -> Scene | None:
        """None: reference motion is imitated on a bare floor."""
        return None

    def followed(self, starts: Tensor | None = None) -> Followed:
        """What bodies follow: the forecasts that begin at ``starts [W]``, each once, or the states of every frame.

        Raises:
            ValueError: there is nothing to follow.
        """
        if self.motion is None:
            raise ValueError("there is no state regressor whose states bodies could follow")
        return self.motion.followed(starts)

    def _motion(self) -> TargetMotion | None:
        if self.forecasts is not None:
            return CurveMotion(self.forecasts)
        if self.states is None:
            return None
        return TableMotion(self.states, self._integrated() if self.path is None else self.path, self.takes.last())

    def _integrated(self) -> Tensor:
        """``[F, 3]`` the path of :attr:`states`, each take from the origin and along x."""
        assert self.states is not None
        spans = zip(self.takes.offsets.tolist(), self.takes.lengths.tolist(), strict=True)
        path = torch.zeros(self.n_frames, 3, dtype=torch.float64)
        for offset, length in spans:
            rows = self.states[offset : offset + length].double().numpy()
            path[offset : offset + length] = torch.from_numpy(integrated_path(rows, 1.0 / self.humanoid.control_dt))
        return path
