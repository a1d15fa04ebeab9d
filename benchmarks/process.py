"""Times of a new process: the import, and the first plan with and without a cache.

Modules are there as bytecode, as after an installation.
"""

import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from harness import Limit, Row, Timed

import servoctl as sv

ROOT = Path(sv.__file__).parents[1]
IMPORTS = 7  # least number of processes for a median
_bytecode = tempfile.TemporaryDirectory(prefix="servoctl-bytecode-")

FIRST_PLAN = """
import json, time
import servoctl as sv
from servoctl.gallery import gallery

start = time.perf_counter()
scene = gallery["overhead-crane"]
model = sv.derive(*scene.build())
run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span, progress=False)
forces = [run["trolley"].tolist(), run["hoist"].tolist()]
print(json.dumps([time.perf_counter() - start, forces]))
"""
IMPORT = "import json, time; a = time.perf_counter(); import {}; print(json.dumps([time.perf_counter() - a, 0]))"


def fresh(code, cache):
    """Run code in a new process with this cache directory: the seconds that it measures, and its answer."""
    environment = os.environ | {
        "SERVOCTL_CACHE": cache, "SERVOCTL_MEMO": "", "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "",
        "PYTHONPYCACHEPREFIX": _bytecode.name,
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, cwd=cache
    )
    seconds, answer = json.loads(done.stdout)
    return Timed(seconds, np.array(answer))


def cold():
    with tempfile.TemporaryDirectory() as cache:
        return fresh(FIRST_PLAN, cache)


def import_time(rounds):
    with tempfile.TemporaryDirectory() as cache:
        fresh(IMPORT.format("servoctl"), cache)
        return [fresh(IMPORT.format("servoctl"), cache).seconds for _ in range(max(rounds, IMPORTS))]


def cold_time(rounds):
    cold()
    return [cold().seconds for _ in range(rounds)]


def second_process():
    directory = tempfile.TemporaryDirectory()
    exact = fresh(FIRST_PLAN, directory.name).answer

    def warm():
        return fresh(FIRST_PLAN, directory.name)

    def imports():
        return Timed(fresh(IMPORT.format("numpy, casadi"), directory.name).seconds, exact)

    warm.directory = directory  # deleted with the row
    return Row(
        "Crane from specification to first plan: a second process", warm,
        {"the first process, empty cache": cold, "importing numpy and casadi": imports},
        lambda forces: np.abs(forces - exact).max() / np.abs(exact).max(), 1e-9,
        {"the first process, empty cache": 5},
    )  # fmt: skip


ROWS = {
    "import": partial(Limit, "`import servoctl` in a new process", import_time, 0.5, "s"),
    "first-plan": partial(
        Limit, "Crane from specification to first plan, nothing compiled before, with imports", cold_time, 0.3, "s"
    ),
    "second-process": second_process,
}
