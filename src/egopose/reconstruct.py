"""``python -m egopose.reconstruct [prepare] video=FILM [scene=YAML]``: a third person's film becomes motion and scene.

``prepare`` ends with poses, contacts, a first guess of the root and the scene. Without it a simulated body then acts
the clip out among the boxes, and the boxes are fitted. ``poses=FOLDER`` reads what OpenPose found, with ``video=`` or
without. Pages in the folder of results show every stage. A second call does what is missing, and what changed.
"""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError

PREPARE = "prepare"


def _run(config: DictConfig, whole: bool) -> None:
    from egopose.evaluation.reports import reconstruction_report
    from egopose.evaluation.scene_page import write_scene_page
    from egopose.inference.scene_preparation import prepare_scene
    from egopose.inference.scene_recovery import recover_scene

    values = resolved(config)
    try:
        out = prepare_scene(values, write_scene_page)
        print(f"scene: {out / 'scene.yaml'}\npage: {out / 'page.html'}", flush=True)
        if whole:
            recover_scene(values, out, lambda folder, page: reconstruction_report(folder, [f"out={page}"]))
            print(f"motion: {out / 'plan.npz'}\nscene: {out / 'scene.fitted.yaml'}")
            print(f"page: {out / 'reconstruction.html'}")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


@command("reconstruct")
def _prepare(config: DictConfig) -> None:
    """Hydra's entry of the first half."""
    _run(config, whole=False)


@command("reconstruct")
def _reconstruct(config: DictConfig) -> None:
    """Hydra's entry of the whole."""
    _run(config, whole=True)


def main() -> None:
    """The command: ``prepare`` ends before physics."""
    prepare = PREPARE in sys.argv[1:]
    sys.argv[1:] = [word for word in sys.argv[1:] if word != PREPARE]
    (_prepare if prepare else _reconstruct)()


if __name__ == "__main__":
    main()
