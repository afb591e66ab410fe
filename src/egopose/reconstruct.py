"""``python -m egopose.reconstruct prepare video=FILM [scene=YAML]``: from a third person's film to poses and a scene.

``poses=FOLDER`` reads what OpenPose found, with ``video=`` or without. The page in the folder of results shows every
stage. A second call does what is missing, and what changed.
"""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from egopose.core.config import command, resolved
from egopose.core.errors import InputError

_ACTIONS = ("prepare",)


@command("reconstruct")
def _prepare(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.evaluation.scene_page import write_scene_page
    from egopose.inference.scene_preparation import prepare_scene

    try:
        out = prepare_scene(resolved(config), write_scene_page)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"scene: {out / 'scene.yaml'}\npage: {out / 'page.html'}")


def main() -> None:
    """The command: what to do comes first."""
    words = [word for word in sys.argv[1:] if word in _ACTIONS]
    if not words and not {"-h", "--help"} & set(sys.argv[1:]):
        print(f"error: reconstruct: say what to do: {', '.join(_ACTIONS)}", file=sys.stderr)
        raise SystemExit(2)
    sys.argv[1:] = [word for word in sys.argv[1:] if word not in _ACTIONS]
    _prepare()


if __name__ == "__main__":
    main()
