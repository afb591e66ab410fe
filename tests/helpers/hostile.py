"""What a hostile file may cost: one clear error, within stated time and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest

from egopose.core.errors import InputError
from egopose.motion.io import read_motion

LIMIT_MB = 2048
SECONDS_EACH = 20.0

#: Runs in the child: one reader over all files, under a limit on what it may map beyond what its imports took.
CHILD = """
import json, resource, sys, time
from pathlib import Path

kind, *files = sys.argv[1:]
if kind == "motion":
    from egopose.motion.io import read_motion as read
elif kind == "video":
    from egopose.vision.video import iter_frames, probe_video
    read = lambda path: (probe_video(path), sum(1 for _ in iter_frames(path)))
elif kind == "telemetry":
    from egopose.vision.telemetry import read_telemetry as read
else:
    from egopose.core.safe_io import read_json
    read = lambda path: read_json(path, "x")
from egopose.core.errors import InputError

mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (mapped + 2**31, mapped + 2**31))
out = []
for name in files:
    start = time.process_time()
    try:
        read(Path(name))
        said = "read"
    except InputError as error:
        said = f"refused: {error.field}: {error.cause}"
    except MemoryError:
        said = "MemoryError"
    out.append([Path(name).name, said, time.process_time() - start])
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"files": out, "peak_mb": peak}))
"""


def run_child(kind: str, files: list[Path]) -> dict[str, str]:
    """What each file came to, by its name; time and memory are checked here."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", CHILD, kind, *map(str, files)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,  # it is the processor's time that counts
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["peak_mb"] < LIMIT_MB
    print(json.dumps(result, indent=1))
    slow = [entry for entry in result["files"] if entry[2] > SECONDS_EACH]
    assert not slow
    return {name: said for name, said, _ in result["files"]}


def blamed(path: Path, expected: str, **options: object) -> None:
    """One InputError, naming the file, with ``expected`` in it, within 2 s of the processor's time and 300 MB."""
    tracemalloc.start()
    start = time.process_time()
    with pytest.raises(InputError) as caught:
        read_motion(path, **options)
    seconds, (_, peak) = time.process_time() - start, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    message = str(caught.value)
    assert message.startswith(str(path))
    assert expected in message
    assert len(message) < len(str(path)) + 300
    assert "\n" not in message
    assert seconds < 2.0
    assert peak < 300 * 2**20


def reads_or_says_why(path: Path) -> None:
    """A damaged motion file is read, or refused in one line that begins with its path; nothing else may happen."""
    try:
        read_motion(path)
    except InputError as error:
        said = str(error)
    else:
        said = str(path)
    assert said.startswith(str(path))
    assert "\n" not in said
