"""Where the wearer's own limbs are in the picture: a small network that finds them, and what posture they show.

Yuan & Kitani 2019 see through optical flow alone, in which arms that hardly move the head leave no trace. This looks at
the picture itself: two frames, small, and the flow between them. It is trained on rendered bodies in random postures
and rooms (``python -m egopose.train --config-name body_parts``), on no frame of any take that anything is judged on.
"""

from __future__ import annotations

import functools

import torch

from egopose.checkpoint.checkpoint import RunCheckpoint, read_json
from egopose.checkpoint.pretrained import FOLDER
from egopose.core.errors import InputError
from egopose.vision.body_parts import BodyPartEstimator


@functools.cache
def load_body_part_estimator(name: str) -> BodyPartEstimator:
    """A body-part estimator that comes with the package, in evaluation mode.

    Args:
        name: of its folder in ``egopose/weights``.

    Raises:
        InputError: there is none of that name, or a file of it is damaged.
    """
    folder = FOLDER / name
    # A name from an untrusted configuration must not lead out of the package.
    if folder.parent != FOLDER or name in (".", "..") or not (folder / "manifest.json").is_file():
        raise InputError("regressor.kernel", "body_parts", f"no body-part estimator {name!r} comes with egopose")
    config = read_json(folder, "config")
    finder = BodyPartEstimator(len(config["names"]), int(config["channels"]))
    if "mirror" not in config:
        raise InputError(folder, "mirror", "is missing: the estimator was made by an older egopose")
    for key, buffer in (("index", finder.mirror_index), ("sign", finder.mirror_sign)):
        buffer.copy_(torch.tensor(config["mirror"][key]))
    RunCheckpoint({"finder": finder}).restore(folder, {"finder"})
    return finder.eval()
