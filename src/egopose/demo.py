"""``python -m egopose.demo [key=value ...]``: what the pretrained weights make of a person they have not seen.

Renders the wearer's video of a walk, estimates and forecasts the motion from it, and writes one HTML page with moving
pictures, filmstrips and figures.

``python -m egopose.demo train=true [budget=short] [key=value ...]`` trains instead: it prepares all embedded clips,
trains the state regressor and a policy and evaluates them beside PoseReg on held-out frames. Then the pretrained
weights see the same frames. Further words are overrides of ``conf/train.yaml`` in both.
"""

from __future__ import annotations

import sys

from egopose.core.errors import InputError


def main() -> None:
    """The command."""
    words = sys.argv[1:]
    if any(word in ("-h", "--help") for word in words):
        print(__doc__)
        return
    from egopose.evaluation.demo import run_demo, run_training_demo

    own = {key: value for key, _, value in (word.partition("=") for word in words) if key in ("train", "budget")}
    overrides = [word for word in words if word.partition("=")[0] not in own]
    try:
        if own.get("train", "false") not in ("true", "false"):
            raise InputError("demo", "train", f"must be true or false, not {own['train']!r}")
        if own.get("train") == "true":
            run_training_demo(own.get("budget", "full"), overrides)
        elif "budget" in own:
            raise InputError("demo", "budget", "is of training alone: add train=true")
        else:
            run_demo(overrides)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
