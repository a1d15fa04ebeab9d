"""Measure the tests and write the lists of what the first tier and the checks of a change leave out.

    python tests/tiers.py times     CPU seconds of every case, of its compilers, too; in two processes, alone on a machine
    python tests/tiers.py arcs      what the first case of each function executes, by coverage
    python tests/tiers.py write     the lists: tests/left.txt, tests/by_hand.txt

Measurements are added to a folder, by default `tiers` in the system's folder for temporary files. A test that was
skipped in any of them, such as for an extra that is not installed, is in no first tier. The first tier has all
functions that are fast, and of the others those that execute most new arcs per second.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

TESTS = Path(__file__).parent
FOLDER = Path(os.environ.get("SERVOCTL_TIERS", Path(tempfile.gettempdir(), "tiers")))
FAST = 0.3  # CPU s: a first case up to this is in the first tier
FIRST = 300.0  # CPU s of the first tier, collecting left out
CHECKED = 2400.0  # CPU s of what the checks of a change run of the rest
UNTIMED = 0.02  # CPU s that each test costs at least: reports, fixtures


# the plugin of pytest that measures --------------------------------------------------------------------------------


class Measure:
    """Adds a line to a file of its own process for each test."""

    def __init__(self, kind):
        self.kind, self.file, self.coverage = kind, FOLDER / f"{kind}.{os.getpid()}.jsonl", None
        if kind == "arcs":
            import coverage

            data = str(FOLDER / f"coverage.{os.getpid()}")
            self.coverage = coverage.Coverage(data_file=data, branch=True, source_pkgs=["servoctl"], config_file=False)
            self.coverage.start()

    def pytest_collection_modifyitems(self, items):
        if self.kind == "arcs":
            first = {function(item.nodeid): item for item in reversed(items)}
            items[:] = reversed(first.values())

    def pytest_runtest_logreport(self, report):
        if report.skipped:
            self.write({"test": report.nodeid, "skipped": True})

    def pytest_runtest_protocol(self, item, nextitem):
        from _pytest.runner import runtestprotocol

        if self.coverage is not None:
            self.coverage.switch_context(function(item.nodeid))
        before = sum(os.times()[:4])
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        runtestprotocol(item, nextitem=nextitem)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        self.write({"test": item.nodeid, self.kind: round(sum(os.times()[:4]) - before, 3)})
        return True

    def pytest_sessionfinish(self):
        if self.coverage is not None:
            self.coverage.stop()
            self.coverage.save()

    def write(self, line):
        with self.file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def pytest_configure(config):
    """Measure in the processes that run tests."""
    if hasattr(config, "workerinput"):
        config.pluginmanager.register(Measure(os.environ["SERVOCTL_TIERS_KIND"]))


def function(nodeid):
    """The test function of a case, and its file, as in the lists."""
    return nodeid.partition("[")[0].removeprefix("tests/")


def measure(kind):
    """Run every test, or the first case of each function, in two processes."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(TESTS), "SERVOCTL_TIERS": str(FOLDER), "SERVOCTL_TIERS_KIND": kind}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--all", "-p", "tiers"]
    return subprocess.run(command, cwd=TESTS.parent, env=environment, check=False).returncode


# the lists -----------------------------------------------------------------------------------------------------------


def measured():
    """CPU seconds of all cases by their ids, and the names of skipped functions."""
    seconds, skipped = {}, set()
    for file in FOLDER.glob("*.jsonl"):
        for line in map(json.loads, file.read_text(encoding="utf-8").splitlines()):
            if "times" in line:
                seconds[line["test"]] = line["times"]
            if "skipped" in line:
                skipped.add(function(line["test"]))
    return seconds, skipped


def executed():
    """Arcs of the package that each function's first case executes, as a set of numbers by its name."""
    from coverage import CoverageData

    arcs, numbers = {}, {}
    for file in FOLDER.glob("coverage.*"):
        data = CoverageData(str(file))
        data.read()
        for name in data.measured_contexts() - {""}:
            data.set_query_context(name)
            found = ((path, arc) for path in data.measured_files() for arc in data.arcs(path) or ())
            arcs.setdefault(name, set()).update(numbers.setdefault(each, len(numbers)) for each in found)
    return arcs


def chosen(costs, arcs, budget, seen=()):
    """Names in the order of their new arcs per second, as long as the budget lasts."""
    seen, left, taken = set(seen), dict(costs), []
    while left:
        name = max(left, key=lambda one: len(arcs.get(one, set()) - seen) / left[one])
        if budget < left[name]:
            del left[name]  # a cheaper one may still fit
            continue
        budget -= left.pop(name)
        seen |= arcs.get(name, set())
        taken.append(name)
    return taken


def write():
    """Write both lists, and say what they hold."""
    seconds, skipped = measured()
    arcs, firsts, rests = executed(), {}, {}
    for case, cost in seconds.items():  # the first case of a function stands first
        name = function(case)
        if name in firsts:
            rests[name] = rests.get(name, 0.0) + max(cost, UNTIMED)
        else:
            firsts[name] = max(cost, UNTIMED)
    print(firsts and arcs and rests and skipped and len(firsts))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("times", "arcs", "write"))
    step = parser.parse_args().step
    return write() if step == "write" else measure(step)


if __name__ == "__main__":
    sys.exit(main())
