"""Motion capture of several sets, parted into people to learn from and people to be judged on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egopose.core.config import compose_config, convert
from egopose.core.errors import InputError
from egopose.data.preparation import prepare
from egopose.data.splits import WHOLE, split_takes
from egopose.motion.motion import Motion


def folder_to_make(values: Mapping[str, Any]) -> Path:
    """``out``, where what is trained goes. Raises InputError: it is there."""
    out = Path(str(values["out"])).expanduser()
    if out.exists():
        raise InputError(out, "out", "is there already: remove it or name another folder")
    return out


def clips_of(values: Mapping[str, Any], source: str) -> tuple[list[Motion], list[Motion]]:
    """Reference clips to learn from and to be judged on.

    Each of ``sources`` is a choice of ``conf/data``. Those in ``whole`` train with all their takes, others as they are
    split.

    Args:
        values: a resolved configuration with ``sources``, ``whole``, ``humanoid`` and ``sim``.
        source: its file, for errors.

    Raises:
        InputError: a source cannot be used, none is given, or ``whole`` names none of them.
    """
    sources = {name: folder for name, folder in values["sources"].items() if folder is not None}
    whole = convert(values["whole"], tuple[str, ...], source, "whole")
    if not sources:
        raise InputError(source, "sources", "none is given: sources.cmu_people=FOLDER")
    if unknown := set(whole) - set(values["sources"]):
        raise InputError(source, "whole", f"{sorted(unknown)[0]!r} is no source; there are {', '.join(sources)}")
    train: list[Motion] = []
    test: list[Motion] = []
    for name, folder in sources.items():
        config = compose_config("train", [f"data={name}"])
        config["data"]["folder"] = convert(folder, str, source, f"sources.{name}")
        store = prepare({**config, "humanoid": values["humanoid"], "sim": values["sim"]}, flow=False)
        split = WHOLE if name in whole else config["data"]["split"]
        for part, clips in (("train", train), ("test", test)):
            if part == "test" and name in whole:
                continue
            # A split leaves out what a body on a bare floor cannot do; here only what was recorded counts.
            pieces = split_takes(store.takes, split, part, supported_only=False)
            clips += [store.clip(piece.take).slice(piece.start, piece.stop) for piece in pieces]
    return train, test
