"""What a type checker says of a user's script: the README's is accepted, a wrong type is seen."""

import os
import re
import subprocess
import sys
from pathlib import Path

from conftest import needs

ROOT = Path(__file__).parents[1]


def checked(script, folder):
    """Exit code and errors of mypy, with its default settings."""
    needs("mypy")
    (folder / "script.py").write_text(script, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--follow-imports=silent", "--cache-dir", str(folder.parent), "script.py"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    return done.returncode, [line for line in done.stdout.splitlines() if ": error: " in line]


def test_the_package_says_that_it_is_typed():
    assert (ROOT / "servoctl" / "py.typed").exists()


def test_the_readme_is_accepted(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    assert checked("\n".join(blocks), tmp_path) == (0, [])


def test_wrong_types_are_seen(tmp_path):
    script = """import servoctl as sv

def peak(run: sv.types.Run) -> float:
    name: str = run["trolley"]
    return float(run["trolley"].max())

count: int = sv.derive(sv.Mechanism(sv.coordinates("x")), sv.Program({}))
sv.parameters(m="heavy")
"""
    code, errors = checked(script, tmp_path)
    assert code == 1
    assert [int(error.split(":")[1]) for error in errors] == [4, 7, 8]
    assert "ndarray" in errors[0] and "Model" in errors[1] and '"m"' in errors[2]


def test_a_loop_has_its_types(tmp_path):
    script = """import servoctl as sv

def looped(mechanism: sv.Mechanism, plan: sv.types.Run) -> sv.types.Closed:
    plant = sv.plant(mechanism, limits={"trolley": 100.0})
    law: sv.Law = sv.limited(sv.lqr(plan, plant, Q={"theta": 1e4}, integral=True), plant, priority=["X"])
    sensors, timing = sv.Sensors({"theta": 1e-3}, seed=1), sv.Timing(delay=1)
    return sv.close(plant, law, plan.state(0.0), (0.0, 8.0), sensors=sensors, timing=timing)

def worst(run: sv.types.Closed) -> float:
    batch = sv.close_many(run, {"m_load": [90.0, 110.0]}, record=["theta"])
    text: str = run.input["trolley"]
    sv.close(run.plant, run.law, run.states, (0.0, 1.0), timing=0.01)
    law: sv.Law = sv.fastest
    return float(batch["max |theta|"].max())
"""
    code, errors = checked(script, tmp_path)
    assert [int(error.split(":")[1]) for error in errors] == [11, 12, 13], errors
    assert "ndarray" in errors[0] and "Timing" in errors[1] and "Law" in errors[2]
