"""Deliberate small bugs, one at a time in a copy of the package: which of them do the tests let live?

`python tests/adversary/mutants.py` prints one line for each; `--only NAME ...` takes some, `--adversary` runs the random
mechanisms instead of the tests named beside a mutant.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
REDUCTION = ("test_ranks.py", "test_reduction.py", "test_structure.py")
MOTION = ("test_runs_against_closed_forms.py", "test_convergence.py")
MUTANTS = {  # name: (file, old text, new text, tests)
    "fill-in is not registered": (
        "reduction/ranks.py", "                self.members[c][r] = None\n", "                pass\n", REDUCTION,
    ),
    "cancelled entries stay registered": (
        "reduction/ranks.py", "                    del self.members[c][r]\n", "                    pass\n", REDUCTION,
    ),
    "elimination adds": ("reduction/ranks.py", "_difference(old_number, factor_number * a_number)",
        "_difference(old_number, -factor_number * a_number)", REDUCTION),
    "ENTRY x 1e4": ("tolerances.py", "ENTRY = 1e-12", "ENTRY = 1e-8", REDUCTION),
    "NOISE x 100": ("tolerances.py", "NOISE = ", "NOISE = 100 * ", REDUCTION),
    "RESOLVED x 100": ("tolerances.py", "RESOLVED = 1e-10", "RESOLVED = 1e-8", REDUCTION),
    "DEPENDENT x 1e4": ("tolerances.py", "DEPENDENT = 1e-11", "DEPENDENT = 1e-7", ("test_numbers.py",)),
    "CONSISTENT x 100": ("control/close.py", "CONSISTENT = 1e-6", "CONSISTENT = 1e-4", ("test_close.py", "test_plant.py")),
    "pivots without a threshold": ("reduction/ranks.py", "THRESHOLD = 0.1", "THRESHOLD = 0.0", REDUCTION),
    "equilibration stops early": ("reduction/ranks.py", "SWEEPS = 6", "SWEEPS = 1", REDUCTION),
    "a combination is not scaled back": (
        "reduction/ranks.py", "c * (row_factors[:-1] / row_factors[-1])", "c * (row_factors[:-1] * row_factors[-1])",
        REDUCTION,
    ),
    "(3.18) with another sign": (
        "reduction/appell.py", "-transposed[:, independent]", "transposed[:, independent]", REDUCTION,
    ),
    "hidden rows with another sign": (
        "reduction/hidden.py", "target = -rows[b].gradient(q)", "target = rows[b].gradient(q)", REDUCTION,
    ),
    "the lowest row is not differentiated": (
        "reduction/hidden.py", "q.derivatives([rows[a].expression], top - rows[a].order)[-1][0] for a in others",
        "q.derivatives([rows[a].expression], max(top - rows[a].order - 1, 0))[-1][0] for a in others", REDUCTION,
    ),
    "dynamics are the last to be replaced": (
        "reduction/hidden.py", 'max((rows[a].kind == "dynamics", w, a) for a, w in highest)',
        'max((rows[a].kind != "dynamics", w, a) for a, w in highest)', REDUCTION,
    ),
    "least norm without weights": (
        "reduction/realisation.py", "A = _inverse_weights(mechanism, program) @ P.T", "A = P.T",
        ("test_redundant_actuation.py",),
    ),
    "wishes with another sign": (
        "reduction/realisation.py", "mechanism.balance - mechanism.E @ desired_actuation(",
        "mechanism.balance + mechanism.E @ desired_actuation(", ("test_open_actuation.py",),
    ),
    "squares lose their middle term": (
        "jets/series.py", "inner = 0.0 if k % 2 else", "inner = 0.0 if k % 4 else",
        ("test_taylor.py", "test_coordinates.py"),
    ),
    "powers with a wrong factor": (
        "jets/series.py", "exponent * (k - j) - j", "exponent * (k - j) + j", ("test_taylor.py", "test_coordinates.py"),
    ),
    "roots with a wrong range": (
        "jets/series.py", "for j in range(1, k)))\n        return 0.0 if is_zero(rest) else divide(rest, multiply(2.0",
        "for j in range(2, k)))\n        return 0.0 if is_zero(rest) else divide(rest, multiply(2.0",
        ("test_taylor.py", "test_coordinates.py"),
    ),
    "Taylor's factorial is one off": (
        "methods/taylor.py", "                scale = -factorial(k - group.order) / factorial(k)",
        "                scale = -factorial(k - group.order) / factorial(max(k - 1, 1))", ("test_taylor.py",),
    ),
    "Taylor's dense output is one off": (
        "codegen/c/series.h", "product *= (double)(k - m);", "product *= (double)(k - m - 1);",
        ("test_convergence.py", *MOTION[:1]),
    ),
    "RK4 with a wrong weight": (
        "methods/runge_kutta.py", "np.array([1, 2, 2, 1]) / 6", "np.array([1, 2, 1, 2]) / 6", MOTION,
    ),
    "the hold is half a period": (
        "control/sampling.py", "(B, period, out", "(B, period / 2, out", ("test_lqr.py", "test_sampling.py"),
    ),
    "exponentials lose their last terms": (
        "control/sampling.py", "SCALED, TERMS = 0.5, 16", "SCALED, TERMS = 0.5, 6", ("test_lqr.py", "test_sampling.py"),
    ),
    "the integral without its period": (
        "control/lqr.py", "reference.period * residuals.jacobian", "residuals.jacobian", ("test_lqr.py",),
    ),
}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=list(MUTANTS), choices=list(MUTANTS), metavar="NAME")
    parser.add_argument("--adversary", action="store_true", help="random mechanisms instead of named tests")
    parser.add_argument("--limit", type=float, default=600.0, help="seconds for a mutant")
    options = parser.parse_args()
    survivors = []
    for name in options.only:
        start = time.monotonic()
        end = outcome(*MUTANTS[name], options.adversary, options.limit)
        survivors += [name] * (end == "SURVIVES")
        print(f"{end:10s} {time.monotonic() - start:5.0f} s  {name}", flush=True)
    print(f"{len(survivors)} of {len(options.only)} survive")
    return 1 if survivors else 0


def outcome(file, old, new, tests, adversary, limit):
    """Apply one bug to a copy of the project and run what should see it."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", "__pycache__", ".venv", "*.npz", "figures.out"))
        path = copy / "servoctl" / file
        text = path.read_text(encoding="utf-8")
        if text.count(old) != 1:
            return "NO PLACE"  # the package has changed: give the mutant another place
        path.write_text(text.replace(old, new), encoding="utf-8")
        tests = ("adversary",) if adversary else tests
        command = ["-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *(f"tests/{test}" for test in tests)]
        environment = os.environ | {"PYTHONPATH": str(copy), "SERVOCTL_CACHE": f"{folder}/cache"}
        try:
            done = subprocess.run(
                [sys.executable, *command], cwd=copy, env=environment, capture_output=True, timeout=limit, check=False
            )
        except subprocess.TimeoutExpired:
            return "too long"
        return "caught" if done.returncode else "SURVIVES"


if __name__ == "__main__":
    sys.exit(main())
