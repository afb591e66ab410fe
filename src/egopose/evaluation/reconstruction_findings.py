"""How well a reconstruction did: contacts wanted and found, feet that slide or sink, and where it fails."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from egopose.evaluation.position_metrics import foot_slide
from egopose.humanoid.surface_contacts import depths
from egopose.inference.reconstruction import Reconstruction
from egopose.inference.scene_stages import sole_points
from egopose.motion.contacts import runs_of
from egopose.motion.motion import Motion
from egopose.motion.rotations import Array
from egopose.scene.clip import BODIES, box_poses, wanted_contacts
from egopose.scene.contacts import FEET
from egopose.scene.scene_file import FLOOR

#: Frames: what lasts a shorter time is not told; contacts of a film are off by so much.
_SHORTEST = 3
#: m, ours: a root further from the kinematic one has taken another way; feet deeper in the ground are seen to sink.
_FAR, _DEEP = 0.3, 0.02


@dataclass(frozen=True)
class ContactFound:
    """One end effector on one surface: frames in which the scene wants it, and in which the body touches it."""

    effector: str
    surface: str
    wanted: NDArray[np.bool_]
    found: NDArray[np.bool_]


@dataclass(frozen=True)
class Soundness:
    """What a motion does that no body does.

    Args:
        slide: m/s, see :func:`egopose.evaluation.position_metrics.foot_slide`, while the clip says that feet touch.
        deepest: m, the most that it reaches into the floor or a box.
        depth: m, the mean over frames of the most in each.
        sunk: share of frames in which it reaches deeper than 2 cm.
    """

    slide: float
    deepest: float
    depth: float
    sunk: float


@dataclass(frozen=True)
class Findings:
    """Of a reconstruction; the kinematic motion is seen among the boxes of the first guess."""

    found: Reconstruction

    @cached_property
    def touching(self) -> NDArray[np.bool_]:
        """``[T, B, 1 + K]``: what the simulated bodies touch at each frame."""
        return self.found.forces.any_at_frame(self.found.forces.touching)

    @cached_property
    def contacts(self) -> tuple[ContactFound, ...]:
        """Of every end effector and surface that the scene names or the body touches."""
        scene, humanoid = self.found.scene, self.found.humanoid
        wanted = wanted_contacts(scene, humanoid, len(self.found.motion))
        out = []
        for effector, body in BODIES.items():
            row = humanoid.skeleton.index(body)
            for column, surface in enumerate(self.surfaces):
                one = ContactFound(effector, surface, wanted[:, row, column], self.touching[:, row, column])
                if one.wanted.any() or one.found.any():
                    out.append(one)
        return tuple(out)

    @property
    def surfaces(self) -> list[str]:
        """Names: the floor, then the boxes."""
        return [FLOOR, *(box.name for box in self.found.scene.boxes)]

    @cached_property
    def root_distance(self) -> Array:
        """``[T]`` m from the kinematic root to the simulated one."""
        return np.asarray(np.linalg.norm(self.found.motion.qpos[:, :3] - self.found.clip.body.qpos[:, :3], axis=1))

    @cached_property
    def joint_distance(self) -> Array:
        """``[T]`` m, the mean over joints between the two bodies with their roots laid upon each other."""
        places = [motion.forward_kinematics()[0] for motion in (self.found.motion, self.found.clip.body)]
        apart = (places[0] - places[0][:, :1]) - (places[1] - places[1][:, :1])
        return np.asarray(np.linalg.norm(apart, axis=2).mean(axis=1))

    @cached_property
    def depth(self) -> Array:
        """``[T]`` m: the most that the simulated body reaches into anything."""
        return self._depth(self.found.motion, simulated=True)

    @cached_property
    def simulated(self) -> Soundness:
        return self._soundness(self.found.motion, self.depth)

    @cached_property
    def kinematic(self) -> Soundness:
        return self._soundness(self.found.clip.body, self._depth(self.found.clip.body, simulated=False))

    @cached_property
    def own_slide(self) -> float:
        """m/s: how fast the simulated feet slide while they touch something in the simulation."""
        feet = [self.found.humanoid.skeleton.index(BODIES[f"{side}_foot"]) for side in FEET]
        touching = np.any(self.touching[:, feet], axis=2)
        motion = self.found.motion
        return foot_slide(sole_points(self.found.humanoid, motion), touching, motion.fps)

    def _depth(self, motion: Motion, *, simulated: bool) -> Array:
        scene = self.found.scene if simulated else self.found.clip.scene
        found = depths(self.found.humanoid, motion.qpos, *box_poses(scene))
        return np.asarray(np.nan_to_num(found).max(axis=(1, 2)))

    def _soundness(self, motion: Motion, depth: Array) -> Soundness:
        slide = foot_slide(sole_points(self.found.humanoid, motion), self.found.clip.touching, motion.fps)
        return Soundness(slide, float(depth.max()), float(depth.mean()), float((depth > _DEEP).mean()))

    def failures(self) -> list[str]:
        """Where it does not do what the film shows or what a body does, a sentence each, in the order of time."""
        told = [*self._missing(), *self._fallen(), *self._beyond(), *self._away(), *self._sunk()]
        return [sentence for _, sentence in sorted(told, key=lambda one: one[0])]

    def _missing(self) -> Iterator[tuple[int, str]]:
        for one in self.contacts:
            for first, stop in _spans(one.wanted & ~one.found):
                missing = f"the {_plain(one.effector)} should touch {_named(one.surface)}"
                yield first, f"{_said(first, stop)}: {missing} and does not."

    def _beyond(self) -> Iterator[tuple[int, str]]:
        anywhere = {e: np.any([c.wanted for c in self.contacts if c.effector == e], axis=0) for e in BODIES}
        for one in self.contacts:
            for first, stop in _spans(one.found & ~one.wanted):
                instead = ", instead of what it should touch" if anywhere[one.effector][first:stop].all() else ""
                touches = f"the {_plain(one.effector)} touches {_named(one.surface)}{instead}"
                yield first, f"{_said(first, stop)}: {touches}; the scene does not say so."

    def _fallen(self) -> Iterator[tuple[int, str]]:
        names = self.found.humanoid.skeleton.names
        others = [row for row, name in enumerate(names) if name not in BODIES.values()]
        for column, surface in enumerate(self.surfaces):
            touched = self.touching[:, others, column]
            for first, stop in runs_of(np.any(touched, axis=1)):
                bodies = [names[others[k]] for k in np.flatnonzero(touched[first:stop].any(axis=0))]
                lying = f"{', '.join(bodies)} on {_named(surface)}"
                yield first, f"{_said(first, stop)}: {lying}: only feet and hands should touch."

    def _away(self) -> Iterator[tuple[int, str]]:
        for first, stop in _spans(self.root_distance > _FAR):
            most = self.root_distance[first:stop].max()
            yield first, f"{_said(first, stop)}: the root is up to {most:.2f} m from the way read off the film."

    def _sunk(self) -> Iterator[tuple[int, str]]:
        for first, stop in _spans(self.depth > _DEEP):
            most = 1e3 * self.depth[first:stop].max()
            yield first, f"{_said(first, stop)}: the body reaches up to {most:.0f} mm into the ground."


def _spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    return [(first, stop) for first, stop in runs_of(flags) if stop - first >= _SHORTEST]


def _said(first: int, stop: int) -> str:
    return f"Frame {first}" if stop == first + 1 else f"Frames {first} to {stop - 1}"


def _plain(effector: str) -> str:
    return effector.replace("_", " ")


def _named(surface: str) -> str:
    return "the floor" if surface == FLOOR else surface
