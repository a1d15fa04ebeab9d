"""Constants that decide, ten times larger and ten times smaller: do tests see it?

`python tests/adversary/constants.py methods/rank.py LOST HELPS --tests test_stops.py` prints a line for each
value. A test that fails pins the constant from that side; tests/pinned.txt names it.
"""

import argparse
import re
import sys

from mutants import ROOT, outcome


def scaled(text, name, factor):
    """(old, new) text of the definition of a constant; whole numbers stay whole, and at least 1."""
    old = re.search(rf"^{name} = ([^#\n]+?)(?=\s*(?:#|$))", text, re.MULTILINE)
    if old is None:
        raise SystemExit(f"no constant {name}")
    value = old[1]
    new = f"max(1, round({factor} * {value}))" if re.fullmatch(r"\d+", value) else f"{factor} * {value}"
    return old[0], f"{name} = {new}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", help="inside servoctl")
    parser.add_argument("names", nargs="+")
    parser.add_argument("--tests", nargs="+", required=True)
    parser.add_argument("--limit", type=float, default=600.0, help="seconds for a value")
    options = parser.parse_args()
    text = (ROOT / "servoctl" / options.file).read_text(encoding="utf-8")
    for name in options.names:
        for factor in (10, 0.1):
            old, new = scaled(text, name, factor)
            result = outcome(options.file, old, new, options.tests, False, options.limit)
            print(f"{result:10s} {name} x {factor}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
