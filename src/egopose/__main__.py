"""``egopose VERB [key=value ...]``: one command, a verb for each main; ``python -m egopose.VERB`` is the same."""

from __future__ import annotations

import difflib
import importlib
import sys
from importlib.metadata import version

VERBS = {
    "demo": "train a policy on the default data, evaluate it, show a table and a video",
    "prepare": "turn motion files and videos into a store: retarget, render or decode, flow, features",
    "sync": "find the offset between a video and a motion, by how the head turns in both",
    "train": "train a policy (Hydra: group=choice key=value, --multirun)",
    "baseline": "train a method that policies are compared with: ERD, acLSTM, PathPose",
    "limbs": "train what finds the wearer's limbs in the picture, on pictures it draws",
    "evaluate": "score a checkpoint on held-out takes beside PoseReg: tables, CSV, BVH, side-by-side MP4",
    "kappa": "choose the fail-safe's threshold for a run on its training takes",
    "estimate": "motion from a video alone: BVH and MP4",
    "export": "motions for other programs: BVH, GLB, AMASS npz, TRC, C3D, OpenSim, CSV",
    "view": "look at motions, estimates and forecasts in the browser",
    "ship": "a trained run as a small folder to be given away: no optimisers, no paths of this machine",
    "report": "one HTML page of an evaluation or a sweep: tables, curves, pictures",
    "stream": "motion live from a camera, a video or an address: WebSocket, file, latencies",
    "bench": "measure the environment's and the pipeline's speed",
    "completion": "print the script that completes verbs and settings in bash or zsh",
}


def usage() -> str:
    """The help text."""
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {verb.ljust(width)}  {what}" for verb, what in VERBS.items())
    more = 'egopose VERB --help says more of one; eval "$(egopose completion bash)" lets the shell complete them.'
    return f"usage: egopose VERB [key=value ...]\n       egopose --version\n\n{verbs}\n\n{more}"


def main() -> None:
    """Run the verb's own main, with the remaining arguments as its command line."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        raise SystemExit(0 if arguments else 2)
    if arguments[0] == "--version":
        print(f"egopose {version('egopose')}")
        raise SystemExit(0)
    verb = arguments[0]
    if verb not in VERBS:
        near = difflib.get_close_matches(verb, VERBS, 1)
        meant = f"; did you mean {near[0]}?" if near else ""
        print(f"error: no verb {verb!r}{meant}\n\n{usage()}", file=sys.stderr)
        raise SystemExit(2)
    sys.argv = [f"egopose {verb}", *arguments[1:]]
    importlib.import_module(f"egopose.{verb}").main()


if __name__ == "__main__":
    main()
