"""The verbs of the command ``egopose``, and what each does in a line."""

from __future__ import annotations

VERBS = {
    "demo": "train a policy on the default data, evaluate it, show a table and a video",
    "prepare": "turn motion files and videos into a store: retarget, render or decode, flow, features",
    "sync": "find the offset between a video and a motion, by how the head turns in both",
    "train": "train a policy, or the body-part estimator (Hydra: group=choice key=value, --multirun)",
    "baseline": "train a method that policies are compared with: ERD, acLSTM, PathPose",
    "evaluate": "score a checkpoint on held-out takes beside PoseReg: tables, CSV, BVH, side-by-side MP4",
    "estimate": "motion from a video alone: BVH and MP4",
    "export": "motions for other programs: BVH, GLB, AMASS npz, TRC, C3D, OpenSim, CSV",
    "view": "look at motions, estimates and forecasts in the browser",
    "package": "turn a trained run into a small folder to give away: no optimisers, no local paths",
    "report": "one HTML page of an evaluation or a sweep: tables, curves, pictures",
    "stream": "motion live from a camera, a video or an address: WebSocket, file, latencies",
    "bench": "measure the environment's and the pipeline's speed",
    "completion": "print the script that completes verbs and settings in bash or zsh",
}
#: Verbs under their former names, which still work.
FORMER = {"ship": "package"}

#: The measurements of ``egopose bench`` and how many rounds each takes unless told.
BENCHMARKS = {
    "env": 9,
    "update": 5,
    "resume": 50,
    "features": 9,
    "scaling": 5,
    "rates": 3,
    "retarget": 3,
    "export": 1,
    "sync": 8,
    "stream": 1,
    "plan": 9,
}
