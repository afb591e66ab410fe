"""The true clips of ``egopose bench scenes``, and what the command's words choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egopose.benchmarks.scene_contacts import feet_touching, touching
from egopose.core.errors import InputError
from egopose.evaluation.scene_metrics import SceneMotion
from egopose.humanoid.model import HumanoidModel
from egopose.motion.contacts import without_short_runs
from egopose.motion.motion import Motion
from egopose.scene.clip import humanoid_in
from egopose.scene.scene_file import Scene, read_scene
from egopose.scene.simulated import SimulatedMotion, load_simulated
from egopose.scene.virtual_camera import KINDS

_SOURCE = "bench scenes"
_LONGEST_GAP = 2  # frames
_SWITCH = {"true": True, "yes": True, "false": False, "no": False}
NOISES = ("measured", "hard", "none")
BOXES = ("guessed", "none")
#: Whether a simulated body acts a clip out: not at all, among the boxes of the first guess, or among fitted ones.
PHYSICS = ("none", "given", "fitted")


@dataclass(frozen=True)
class Chosen:
    """What the words of the command choose, ``key=one,two``.

    Args:
        clips: names of folders of true clips; empty for all.
        cameras: of :data:`egopose.scene.virtual_camera.KINDS`; ``zoom`` turns and zooms.
        noise: of :data:`NOISES`.
        boxes: of :data:`BOXES`: a scene with boxes moved from their true places is given, or no scene at all.
        gap: leave 30 frames without anybody.
        physics: of :data:`PHYSICS`: whether a simulated body acts the clips out, and its boxes may change.
        folder: of the results; empty for one that is thrown away.
        judge_only: make nothing, judge what is in the folder.
        source: the folder of the true clips; empty for those that come with the project.
    """

    clips: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ("fixed", "pan", "track")
    noise: tuple[str, ...] = ("measured",)
    boxes: tuple[str, ...] = ("guessed",)
    gap: bool = False
    physics: tuple[str, ...] = ("none",)
    folder: str = ""
    judge_only: bool = False
    source: str = ""

    @staticmethod
    def of(words: Sequence[str]) -> Chosen:
        """Of the command's words.

        Raises:
            InputError: an unknown key, or a value that cannot be; names it.
        """
        known = [field.name for field in fields(Chosen)]
        given: dict[str, object] = {}
        for word in words:
            key, _, text = word.partition("=")
            if key not in known:
                raise InputError(_SOURCE, key, f"is no setting; there are {', '.join(known)}")
            if key in ("gap", "judge_only"):
                if text not in _SWITCH:
                    raise InputError(_SOURCE, key, f"{text!r:.40}; true or false")
                given[key] = _SWITCH[text]
            else:
                given[key] = text if key in ("folder", "source") else tuple(text.split(","))
        chosen = Chosen(**given)  # type: ignore[arg-type]
        for key, names in (("cameras", KINDS), ("noise", NOISES), ("boxes", BOXES), ("physics", PHYSICS)):
            if unknown := [one for one in getattr(chosen, key) if one not in names]:
                raise InputError(_SOURCE, key, f"{unknown[0]!r:.40}; there are {', '.join(names)}")
        if chosen.judge_only and not chosen.folder:
            raise InputError(_SOURCE, "judge_only", "needs folder=FOLDER, where an earlier run left its results")
        return chosen


@dataclass(frozen=True)
class TrueClip:
    """A simulated motion, its scene, and its contacts: ``feet [T, 2]`` right and left, on the floor or a box."""

    name: str
    simulated: SimulatedMotion
    scene: Scene
    feet: NDArray[np.bool_]

    def part(self, humanoid: HumanoidModel, start: int, count: int) -> SceneMotion:
        """Some frames of it, to be compared with."""
        rows = slice(start, start + count)
        motion = Motion(humanoid.skeleton, self.simulated.qpos[rows], self.scene.fps, self.name)
        return SceneMotion(motion, self.feet[rows], self.scene)


def clips_folder(source: str) -> Path:
    """The folder of true clips: ``source``, else inside the installed package or of the checkout.

    Raises:
        InputError: it is not there.
    """
    package = Path(__file__).resolve().parents[1]
    places = [package / "scene_clips", package.parents[1] / "experiments" / "scene_bench" / "clips"]
    for place in [Path(source).expanduser()] if source else places:
        if place.is_dir():
            return place
    raise InputError(source or places[-1], "source", "there is no such folder of true clips")


def clip_names(folder: Path, wanted: Sequence[str]) -> list[str]:
    """Those that are wanted, or all in the folder by name.

    Raises:
        InputError: one is not there.
    """
    there = sorted(path.parent.name for path in folder.glob("*/truth.npz"))
    for name in wanted:
        if name not in there:
            raise InputError(folder, "clips", f"{name!r:.40} is not there; there are {', '.join(there)}"[:300])
    return list(wanted) or there


def read_true_clip(folder: Path, humanoid: HumanoidModel) -> TrueClip:
    """Read ``truth.npz`` and ``scene.yaml``, and play the motion again for its contacts.

    Raises:
        InputError: a file is missing or damaged, or the simulation does not come back.
    """
    simulated, scene = load_simulated(folder / "truth.npz"), read_scene(folder / "scene.yaml")
    return TrueClip(folder.name, simulated, scene, simulated_feet(folder / "truth.npz", simulated, scene, humanoid))


def simulated_feet(path: Path, simulated: SimulatedMotion, scene: Scene, humanoid: HumanoidModel) -> NDArray[np.bool_]:
    """``[T, 2]`` whether the right and the left foot touch anything, by playing a motion again.

    Gaps of one or two frames are filled: sensors tell of the last substep alone.

    Raises:
        InputError: it is of another body or other boxes, or does not come back; names ``path``.
    """
    among = humanoid_in(scene, humanoid)
    model = among.mj_model
    shapes = (simulated.qpos.shape[1], simulated.ctrl.shape[1], len(simulated.box_tops))
    if shapes != (model.nq, model.nu, len(scene.boxes)):
        cause = f"coordinates, controls and boxes are {shapes}, not {(model.nq, model.nu, len(scene.boxes))}"
        raise InputError(path, "qpos", cause)
    try:
        feet = feet_touching(among, touching(among, simulated))
        return ~without_short_runs(~feet, _LONGEST_GAP + 1)
    except RuntimeError as error:
        raise InputError(path, "ctrl", str(error)) from None
