"""The verbs of the command ``egopose``, and what each does in a line."""

from __future__ import annotations

VERBS = {
    "demo": "show on one page what the pretrained weights make of an unseen person; train=true trains a policy",
    "prepare": "make a store of motion files and videos: retargeting, rendering, optical flow, features",
    "sync": "find the offset between a video and a motion by the turns of the head",
    "train": "train a policy, or the body-part estimator (Hydra: group=choice key=value, --multirun)",
    "baseline": "train a method to compare with: ERD, acLSTM, PathPose",
    "evaluate": "score a checkpoint on held-out takes beside PoseReg: tables, CSV, BVH, side-by-side MP4",
    "estimate": "estimate the motion of a video: BVH and MP4",
    "export": "write motions for other programs: BVH, GLB, AMASS npz, TRC, C3D, OpenSim, CSV",
    "view": "show motions, estimates, forecasts and reconstructions in the browser",
    "package": "make a small folder of a trained run to give away: no optimisers, no local paths",
    "reconstruct": "act out a third person's film in physics, among fitted boxes; `prepare` ends before physics",
    "report": "make one HTML page of an evaluation, a sweep or a reconstruction: tables, curves, pictures",
    "stream": "estimate motion live from a camera, a video or an address: WebSocket, file, latencies",
    "bench": "measure the speed of the environment and of the pipeline",
    "completion": "print the script that completes verbs and settings in bash or zsh",
}
#: Verbs under their former names, which still work.
FORMER = {"ship": "package"}

#: The measurements of ``egopose bench`` and the default number of rounds of each.
BENCHMARKS = {
    "env": 9,
    "train": 5,
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
    "estimate": 3,
    "film": 2,
    "scenes": 1,
}
