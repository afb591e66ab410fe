"""From a third person's film, or from poses another program found, to a scene: stage by stage, resumable.

Each stage leaves its files in the folder of results with a fingerprint of what went in. A second call makes what is
missing or no longer fits, and everything behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from egopose.checkpoint.contacts import load_contact_network
from egopose.checkpoint.lifting import load_lifting_network
from egopose.checkpoint.pretrained import FOLDER
from egopose.core.config import convert
from egopose.core.errors import InputError
from egopose.core.file_digests import sha256_of
from egopose.core.stages import StageFolder
from egopose.data.preparation import humanoid_of
from egopose.inference import scene_stages as stages
from egopose.inference.progress import StageProgress
from egopose.inference.scene_stages import Advance, Sources
from egopose.scene.scene_file import Scene, read_scene, tells_boxes
from egopose.vision.video import probe_video

#: What a frame costs in each stage, ms: measured on two cores on a film of 1000 x 800 px.
COSTS = {"poses": 250.0, "camera": 40.0, "sides": 2.0, "contacts": 1.0, "joints": 1.0, "motion": 20.0, "root": 3.0}
COSTS |= {"scene": 1.0, "page": 30.0}
#: Changes with what the stages compute from the same inputs.
_VERSION = 8
_SCENE = "scene.yaml"


def prepare_scene(
    values: Mapping[str, Any], write_page: Callable[[Sources, Path, Mapping[str, Any], Path], None]
) -> Path:
    """Run ``conf/reconstruct.yaml``, resolved, and return the folder of results.

    Args:
        values: the settings.
        write_page: writes ``page.html`` from sources, the folder of results and the settings' ``page`` to a folder.

    Raises:
        InputError: a file or a setting cannot be used. Stages that were made stay.
    """
    sources, out = _sources(values), _out(values)
    try:
        store = StageFolder(out)
    except OSError as error:
        raise InputError(out, "out", f"cannot be made: {error.strerror}") from None
    edited = store.altered("scene") and (out / _SCENE).is_file()
    scene = _scene(values, out / _SCENE if edited else None, sources)
    network = FOLDER / "contacts" if values["contacts"]["network"] is None else Path(values["contacts"]["network"])
    loaded = load_contact_network(network)
    humanoid = humanoid_of(values)
    inputs = _inputs(values, sources, network)
    body = {"humanoid": values["humanoid"], "sim": values["sim"]}
    frames = _frames(sources)
    with StageProgress(COSTS, frames) as progress:

        def run(name: str, more: Mapping[str, Any], write: Callable[[Advance, Path], None]) -> None:
            everything = {**more, "version": _VERSION}
            if store.done(name, everything):
                return
            with progress.stage(name) as advance:
                store.make(name, everything, lambda part: write(advance, part))

        def of(*files: str) -> dict[str, str]:
            return {file: store.digest(file) for file in files}

        source, folder = sources.name, store.folder
        told, camera = _of_contacts(scene), _of_camera(scene)
        given = edited or (values["scene"] is not None and tells_boxes(Path(str(values["scene"])).expanduser()))
        boxes = [repr(box) for box in scene.boxes] if given else None
        run("poses", inputs["poses"], lambda advance, part: stages.find_poses(values, sources, advance, part))
        run(
            "camera",
            {**inputs["camera"], **of("poses.npz")},
            lambda advance, part: stages.follow_camera(values, sources, folder, advance, part),
        )
        run("sides", of("poses.npz", "camera.npz"), lambda _, part: stages.mend(folder, sources, part))
        run(
            "contacts",
            {**inputs["contacts"], **of("mended.npz", "camera.npz")},
            lambda _, part: stages.tell_contacts(values, loaded, folder, part),
        )
        run(
            "joints",
            {**of("mended.npz", "camera.npz"), "weights": _weights(FOLDER / "lifter")},
            lambda _, part: stages.lift_joints(folder, load_lifting_network(), part),
        )
        run(
            "motion",
            {**of("joints.npz", "camera.npz", "contacts.npz"), "told": told, "camera": camera, **body},
            lambda _, part: stages.pose_body(folder, source, scene, humanoid, part),
        )
        run(
            "root",
            {
                **of("motion.npz", "contacts.npz", "joints.npz", "camera.npz"),
                **{"told": told, "camera": camera, "boxes": boxes},
                **body,
            },
            lambda _, part: stages.place_root(folder, source, scene, given, humanoid, part),
        )
        if not edited:
            run(
                "scene",
                {**of("body.npz", "root.npz", "fit.json"), "scene": repr(scene), "given": given},
                lambda _, part: stages.fill_scene(folder, scene, given, humanoid, part),
            )
        run(
            "page",
            {**of("body.npz", "root.npz", "fit.json", _SCENE), **values["page"]},
            lambda _, part: write_page(sources, folder, values["page"], part),
        )
    return out


def _sources(values: Mapping[str, Any]) -> Sources:
    video, poses = (convert(values[name], str | None, "conf/reconstruct.yaml", name) for name in ("video", "poses"))
    if video is None and poses is None:
        raise InputError("reconstruct", "video", "none is given: video=FILM, or poses=FOLDER of OpenPose's JSON")
    for name, path in (("video", video), ("poses", poses)):
        if path is not None and not Path(path).expanduser().exists():
            raise InputError(path, name, "no such file or folder")
    return Sources(
        None if video is None else Path(video).expanduser(),
        None if poses is None else Path(poses).expanduser(),
        float(values["sim"]["control_hz"]),
    )


def _out(values: Mapping[str, Any]) -> Path:
    if values["out"] is not None:
        return Path(str(values["out"])).expanduser()
    path = Path(str(values["video"] or values["poses"])).expanduser()
    return path.with_name(f"{path.stem}.reconstruct")


def _scene(values: Mapping[str, Any], edited: Path | None, sources: Sources) -> Scene:
    """The scene that is given, else the one in the folder of results where a user changed it, else none."""
    path = convert(values["scene"], str | None, "conf/reconstruct.yaml", "scene")
    if path is not None and edited is not None:
        raise InputError(edited, "scene", f"was changed by hand: leave out scene={path} to use it, or remove the file")
    path = path if edited is None else str(edited)
    if path is None:
        return Scene(fps=sources.fps)
    scene = read_scene(Path(path).expanduser())
    if abs(scene.fps - sources.fps) > 1e-9:
        raise InputError(path, "fps", f"{scene.fps:g}; contacts are counted at {sources.fps:g} frames/s here")
    return scene


def _inputs(values: Mapping[str, Any], sources: Sources, network: Path) -> dict[str, dict[str, Any]]:
    """What of the settings and files goes into each of the first stages."""
    film = None if sources.video is None else sha256_of(sources.video)
    found: Any = None
    if sources.poses is not None:
        files = sorted(sources.poses.glob("*.json")) if sources.poses.is_dir() else [sources.poses]
        found = [[file.name, sha256_of(file)] for file in files]
    told = {"video": film, "found": found, "fps": sources.fps}
    known = convert(values["camera"]["track"], str | None, "conf/reconstruct.yaml", "camera.track")
    if known is not None and not Path(known).expanduser().is_file():
        raise InputError(known, "camera.track", "no such file")
    tracked = {} if known is None else {"track": sha256_of(Path(known).expanduser())}
    return {
        "poses": {**told, "at": values["at"], "read": values["read"], "turns": values["estimator"]["turns"]},
        "camera": {"video": film, "kind": values["camera"]["kind"], **tracked},
        "contacts": {**{k: v for k, v in values["contacts"].items() if k != "network"}, "weights": _weights(network)},
    }


def _weights(folder: Path) -> list[list[str]]:
    return [[str(p.relative_to(folder)), sha256_of(p)] for p in sorted(folder.rglob("*")) if p.is_file()]


def _of_contacts(scene: Scene) -> list[str]:
    return [repr(contact) for contact in scene.contacts if contact.effector.endswith("_foot")]


def _of_camera(scene: Scene) -> str:
    return repr(scene.camera)


def _frames(sources: Sources) -> int:
    """About how many there are, for the time left."""
    if sources.video is None:
        assert sources.poses is not None
        return sum(1 for _ in sources.poses.glob("*.json")) if sources.poses.is_dir() else 300
    info = probe_video(sources.video)
    return max(1, round(info.frames / info.fps * sources.fps))
