"""``python -m egopose.demo [budget=short] [key=value ...]``: from the embedded clips to a trained, evaluated policy.

Prepares the default data (renders the wearer's video), trains the state regressor and a policy, evaluates them beside
PoseReg on held-out frames and writes tables, motions and side-by-side videos. Then the weights that ship with the
package see the same held-out frames. Further words are overrides of ``conf/train.yaml``.
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
    from egopose.evaluation.demo import run_demo

    budget = next((word.removeprefix("budget=") for word in words if word.startswith("budget=")), "full")
    try:
        run_demo(budget, [word for word in words if not word.startswith("budget=")])
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
