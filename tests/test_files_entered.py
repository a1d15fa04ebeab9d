"""How many files a reader opens who follows a call: from the specification to the first force of the plan."""

import json
import os
import subprocess
import sys
from pathlib import Path

import servoctl as sv

PACKAGE = Path(sv.__file__).parent
MOST = 41  # files from `derive` to the first force

TRACED = """
import json, sys
import servoctl as sv
from servoctl.gallery import gallery

scene, entered = gallery["overhead-crane"], []
mechanism, program = scene.build()
imported = [getattr(sv, name) for name in sv.__all__]

def note(frame, event, argument):
    if event == "call" and frame.f_code.co_name != "<module>":
        entered.append(frame.f_code.co_filename)

sys.setprofile(note)
model = sv.derive(mechanism, program)
run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span, progress=False)
force = run["trolley"]
sys.setprofile(None)
print(json.dumps(entered))
"""


def test_from_a_specification_to_the_first_force_few_files_are_entered():
    environment = os.environ | {"SERVOCTL_MEMO": "none", "SERVOCTL_COMPILER": "none", "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run([sys.executable, "-c", TRACED], env=environment, capture_output=True, text=True, check=True)
    entered = [Path(name) for name in dict.fromkeys(json.loads(done.stdout)) if name.startswith(str(PACKAGE))]
    names = [path.relative_to(PACKAGE).as_posix() for path in entered if path.name != "__init__.py"]
    assert names[0] == "model/model.py" and "reduction/reduce.py" in names[:7] and names[-1] == "run.py"
    assert len(names) <= MOST, names
    assert not {"codegen/emit.py", "codegen/compiler.py"} & set(names), "nothing is emitted where nothing is compiled"
