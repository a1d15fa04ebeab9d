"""Measure the tests and write the lists of what the first tier and the checks of a change leave out.

    python tests/tiers.py times     CPU seconds of every case, of its compilers, too; in two processes, alone on a machine
    python tests/tiers.py arcs      what the first case of each function executes, by coverage
    python tests/tiers.py write     the lists: tests/left.txt, tests/by_hand.txt

Further arguments are pytest's. Measurements are added to a folder, by default `tiers` in the system's folder for
temporary files; empty it before a new start. A test that was skipped in any of them, such as for an extra that is not
installed, is in no first tier. The first two tiers have what executes most new arcs of the package per second, until
their time is spent; a case counts as an arc.
"""

import argparse
import heapq
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

TESTS = Path(__file__).parent
FOLDER = Path(os.environ.get("SERVOCTL_TIERS", Path(tempfile.gettempdir(), "tiers")))
FIRST, SECOND = 250.0, 1000.0  # CPU s of the first two tiers, collecting left out
LEAST = 0.02  # CPU s that a case costs at least, in reports and fixtures


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


def measure(kind, options):
    """Run every test, or the first case of each function, in two processes."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(TESTS), "SERVOCTL_TIERS": str(FOLDER), "SERVOCTL_TIERS_KIND": kind}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--all", "-p", "tiers", *options]
    return subprocess.run(command, cwd=TESTS.parent, env=environment, check=False).returncode


# the lists -----------------------------------------------------------------------------------------------------------


def measured():
    """CPU seconds of each case by its id, ids of first cases by function, and functions that were skipped somewhere."""
    seconds, firsts, skipped = {}, {}, set()
    for file in sorted(FOLDER.glob("*.jsonl")):
        for line in map(json.loads, file.read_text(encoding="utf-8").splitlines()):
            if "times" in line:
                seconds[line["test"]] = max(line["times"], LEAST)
            elif "arcs" in line:
                firsts[function(line["test"])] = line["test"]
                seconds.setdefault(line["test"], max(line["arcs"], LEAST))
            else:
                skipped.add(function(line["test"]))
    return seconds, firsts, skipped


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


def chosen(costs, gains, seen, budget):
    """Names with the most new arcs per second, where a case counts as an arc, until the budget is spent.

    What a name gains only falls as others are taken, so that the heap holds bounds of it.
    """
    heap, taken = [(-math.inf, name) for name in costs], set()
    heapq.heapify(heap)
    while heap:
        _, name = heapq.heappop(heap)
        cases, arcs = gains[name]
        gain = -(cases + len(arcs - seen)) / costs[name]
        if heap and gain > heap[0][0]:
            heapq.heappush(heap, (gain, name))
        elif costs[name] <= budget:
            budget -= costs[name]
            seen |= arcs
            taken.add(name)
    return taken


def write():
    """Write both lists, and say what they leave."""
    seconds, firsts, skipped = measured()
    arcs, reached, cases = executed(), set(), {}
    for case in seconds:
        cases.setdefault(function(case), []).append(case)
    nothing = set()
    costs = {name: seconds[firsts[name]] for name in cases if name not in skipped}
    first = chosen(costs, {name: (1, arcs.get(name, nothing)) for name in costs}, reached, FIRST)
    share = len(reached) / len(set().union(*arcs.values()))
    print(f"first tier: {len(first)} functions, {sum(map(costs.get, first)):.0f} s, {share:.1%} of the arcs of all first cases")
    rest = {name: [case for case in ids if name not in first or case != firsts[name]] for name, ids in cases.items()}
    costs = {name: sum(map(seconds.get, ids)) for name, ids in rest.items() if ids}
    gains = {name: (len(rest[name]), nothing if name in first else arcs.get(name, nothing)) for name in costs}
    second = chosen(costs, gains, reached, SECOND)
    third = sorted(((costs[name], name) for name in costs if name not in second), reverse=True)
    print(f"second tier: {sum(map(costs.get, second)):.0f} s; third: {len(third)} functions, {sum(c for c, _ in third):.0f} s")
    files = {name.partition("::")[0] for name in cases} - {name.partition("::")[0] for name in first}
    left = files | {name for name in cases if name not in first and name.partition("::")[0] not in files}
    TESTS.joinpath("left.txt").write_text("".join(f"{name}\n" for name in sorted(left)), encoding="utf-8")
    by_hand = "".join(f"{cost:.0f} {name}\n" for cost, name in third)
    TESTS.joinpath("by_hand.txt").write_text(by_hand, encoding="utf-8")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("times", "arcs", "write"))
    known, options = parser.parse_known_args()
    return write() if known.step == "write" else measure(known.step, options)


if __name__ == "__main__":
    sys.exit(main())
