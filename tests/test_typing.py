"""What a type checker says of a user's script: the README's is accepted, a wrong type is seen."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def checked(script, folder):
    """Exit code and errors of mypy, with its default settings."""
    pytest.importorskip("mypy", reason="mypy is in the extra 'test'")
    (folder / "script.py").write_text(script)
    command = [sys.executable, "-m", "mypy", "--follow-imports=silent", "--cache-dir", str(folder.parent), "script.py"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    return done.returncode, [line for line in done.stdout.splitlines() if ": error: " in line]


def test_the_package_says_that_it_is_typed():
    assert (ROOT / "servoctl" / "py.typed").exists()


def test_the_readme_is_accepted(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert checked("\n".join(blocks), tmp_path) == (0, [])


def test_wrong_types_are_seen(tmp_path):
    script = """import servoctl as sv

def peak(run: sv.Run) -> float:
    name: str = run["trolley"]
    return float(run["trolley"].max())

count: int = sv.derive(sv.Mechanism(sv.coordinates("x")), sv.Program({}))
sv.parameters(m="heavy")
"""
    code, errors = checked(script, tmp_path)
    assert code == 1
    assert [int(error.split(":")[1]) for error in errors] == [4, 7, 8]
    assert "ndarray" in errors[0] and "Model" in errors[1] and '"m"' in errors[2]
