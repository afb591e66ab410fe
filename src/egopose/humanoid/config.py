"""What a humanoid is made of: one table row a joint, the sizes of the feet, the simulation's rates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from egopose.core.errors import InputError
from egopose.motion.skeleton import Dof, Joint, Skeleton

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class JointRow:
    """One body and the hinges that move it against its parent.

    Args:
        name: of the body; hinges are called ``name_0 name_1 ...`` in order.
        parent: the parent body's name, None for the root.
        axes: unit hinge axes in the joint's rest frame (x forward, y left, z up, arms held out sideways).
        range_deg: limits of each hinge, degrees.
        kp: proportional gain, N m/rad, for a body of ``reference_mass``.
        torque_limit: N m, for a body of ``reference_mass``.
        mass_fraction: share of the whole body's mass; the column is normalised.
        radius: of the body's capsule, metres.
    """

    name: str
    parent: str | None
    axes: tuple[Vector, ...]
    range_deg: tuple[tuple[float, float], ...]
    kp: float
    torque_limit: float
    mass_fraction: float
    radius: float


@dataclass(frozen=True)
class HumanoidConfig:
    """See ``conf/humanoid/default.yaml``, which gives every value and its source."""

    joints: tuple[JointRow, ...]
    offsets: dict[str, Vector]
    tips: dict[str, Vector]
    ankle_height: float
    toe_height: float
    heel_length: float
    toe_overhang: float
    foot_width: float
    total_mass: float
    reference_mass: float
    kd_ratio: float
    armature: float
    friction: tuple[float, float, float]
    rest_action_deg: dict[str, float]
    end_effectors: tuple[str, ...]
    hands: tuple[str, ...]
    feet: tuple[str, ...]
    head: str

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], source: str = "conf/humanoid") -> HumanoidConfig:
        """Build from a plain mapping (a resolved config group).

        Raises:
            InputError: a key is missing or of the wrong form; names it.
        """
        try:
            rows = tuple(
                JointRow(
                    name=str(r["name"]),
                    parent=r["parent"],
                    axes=tuple(_direction(a, source, f"joints.{r['name']}.axes") for a in r["axes"]),
                    range_deg=tuple((float(a), float(b)) for a, b in r["range_deg"]),
                    kp=float(r["kp"]),
                    torque_limit=float(r["torque_limit"]),
                    mass_fraction=float(r["mass_fraction"]),
                    radius=float(r["radius"]),
                )
                for r in values["joints"]
            )
            _check_rows(rows, source)
            names = {r.name for r in rows}
            hinges = {f"{r.name}_{k}" for r in rows for k in range(len(r.axes))}
            for key in ("end_effectors", "hands", "feet", "offsets", "tips", "rest_action_deg"):
                if unknown := set(values[key]) - (hinges if key == "rest_action_deg" else names):
                    raise InputError(source, key, f"no such joints: {', '.join(sorted(unknown))}")
            if values["head"] not in names:
                raise InputError(source, "head", f"no such joint: {values['head']}")
            if untipped := {*values["feet"], values["head"]} - set(values["tips"]):
                raise InputError(source, "tips", f"needs {', '.join(sorted(untipped))}")
            return cls(
                joints=rows,
                offsets={k: _vector(v) for k, v in values["offsets"].items()},
                tips={k: _vector(v) for k, v in values["tips"].items()},
                rest_action_deg={k: float(v) for k, v in values["rest_action_deg"].items()},
                friction=_vector(values["friction"]),
                end_effectors=tuple(values["end_effectors"]),
                hands=tuple(values["hands"]),
                feet=tuple(values["feet"]),
                head=str(values["head"]),
                **{k: float(values[k]) for k in _FLOATS},
            )
        except KeyError as error:
            raise InputError(source, str(error.args[0]), "is missing") from None
        except (TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(source, "humanoid", str(error)) from None

    def skeleton(self, name: str = "humanoid") -> Skeleton:
        """The kinematic tree alone, z up, x forward; 21 joints and 58 degrees of freedom with the default table."""
        index = {row.name: i for i, row in enumerate(self.joints)}
        return Skeleton(
            tuple(
                Joint(
                    row.name,
                    -1 if row.parent is None else index[row.parent],
                    self.offsets.get(row.name, (0.0, 0.0, 0.0)),
                    tuple(Dof("hinge", a) for a in row.axes),
                    (self.tips[row.name],) if row.name in self.tips else (),
                )
                for row in self.joints
            ),
            name=name,
        )


_FLOATS = (
    "ankle_height",
    "toe_height",
    "heel_length",
    "toe_overhang",
    "foot_width",
    "total_mass",
    "reference_mass",
    "kd_ratio",
    "armature",
)


def _vector(values: Any) -> Vector:
    x, y, z = (float(v) for v in values)
    return (x, y, z)


def _direction(values: Any, source: str, field: str) -> Vector:
    """The unit vector along ``values``, as MuJoCo takes it: an axis written to six digits is not quite one."""
    x, y, z = _vector(values)
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 1e-6:
        raise InputError(source, field, f"[{x}, {y}, {z}] is no direction")
    return (x / length, y / length, z / length)


def _check_rows(rows: tuple[JointRow, ...], source: str) -> None:
    """Raises InputError unless the rows are a tree with one root, parents first, a range for every hinge."""
    seen: set[str] = set()
    for row in rows:
        if row.name in seen:
            raise InputError(source, f"joints.{row.name}", "stands twice")
        if (row.parent is None) != (not seen) or (row.parent is not None and row.parent not in seen):
            raise InputError(
                source, f"joints.{row.name}.parent", f"{row.parent!r} must stand before it; one root, first"
            )
        if len(row.axes) != len(row.range_deg):
            raise InputError(source, f"joints.{row.name}.range_deg", f"needs {len(row.axes)} ranges")
        seen.add(row.name)


@dataclass(frozen=True)
class SimConfig:
    """Rates and solver of the physics, see ``conf/sim``.

    Args:
        control_hz: the policy's rate.
        substeps: physics steps in one control step.
        solver_iterations: most iterations of the constraint solver a step.
        tolerance: the solver's.
        solver: MuJoCo's name of it: ``Newton`` or ``PGS``, the quicker where constraints are few.

    Raises:
        ValueError: another solver.
    """

    control_hz: float = 30.0
    substeps: int = 15
    solver_iterations: int = 100
    tolerance: float = 1e-8
    solver: str = "Newton"

    def __post_init__(self) -> None:
        if self.solver not in ("Newton", "PGS"):
            raise ValueError(f"solver must be Newton or PGS, not {self.solver!r}")

    @property
    def timestep(self) -> float:
        """Seconds of one physics step."""
        return 1.0 / (self.control_hz * self.substeps)
