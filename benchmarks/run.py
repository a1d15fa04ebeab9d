"""Measure rows and print the table: ``python benchmarks/run.py [row ...] [--rounds N] [--update]``."""

import argparse
import json
from datetime import datetime, timezone
from pathlib import Path

import appell_hamel
import arms
import bounded
import compiling
import crane
import derivation
import harness
import loop
import many
import monte_carlo
import process
import relaxed

GROUPS = (appell_hamel, crane, bounded, relaxed, arms, loop, many, monte_carlo, derivation, compiling, process)
ROWS = {name: row for group in GROUPS for name, row in group.ROWS.items()}
HERE = Path(__file__).parent
RESULTS, README = HERE / "results.json", HERE / "README.md"
BEGIN, END = "<!-- results -->\n", "<!-- end of results -->\n"


def number(value, unit=""):
    if unit == "s":
        scale, name = next(((s, n) for s, n in ((1.0, "s"), (1e3, "ms")) if value * s >= 0.1), (1e6, "µs"))
        return f"{number(value * scale)} {name}"
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def verdict(line):
    if line["met"] is None:
        return line["missing"]
    if not line.get("agree", True):
        return "fails: answers differ"
    return "" if line["bar"] is None else "yes" if line["met"] else "**no**"


def table(results):
    """Markdown of results, a line for each peer."""
    lines = ["| row | compared with | peer / ours (quartiles) | bar | met | peer, ours | errors |", "|" + "---|" * 7]
    for key, result in results.items():
        for i, line in enumerate(result["lines"]):
            lines.append(f"| {'' if i else _title(key, result)} | " + " | ".join(_cells(line)) + " |")
    return "\n".join(lines) + "\n"


def _title(key, result):
    return f"`{key}` {result['title']}"


def _cells(line):
    if "value" in line:
        spread = f" ({number(line['low'])}–{number(line['high'])})" if line["high"] > line["low"] else ""
        value, bar = number(line["value"], line["unit"]), number(line["bar"], line["unit"])
        return "", f"{value}{spread if not line['unit'] else ''}", f"≤ {bar}", verdict(line), "", ""
    bar = "" if line["bar"] is None else f"≥ {line['bar']:g}"
    if line["met"] is None:
        return line["peer"], "", bar, verdict(line), "", ""
    ratio = f"{number(line['ratio'])} ({number(line['low'])}–{number(line['high'])})"
    times = f"{number(line['seconds'], 's')}, {number(line['our_seconds'], 's')}"
    return line["peer"], ratio, bar, verdict(line), times, f"{line['error']:.0e}, {line['our_error']:.0e}"


def machines(results):
    """One line for each machine on which results were measured, in the order of the rows."""
    seen = {}
    for key, result in results.items():
        m = result["machine"]
        versions = ", ".join(f"{name} {version}" for name, version in m["versions"].items())
        about = f"{m['processor']}, {m['cores']} cores, {m['system']}; {m['compiler']}; {versions}"
        seen.setdefault(about, []).append(key)
    whole = len(seen) == 1
    return "\n".join(about + ("" if whole else f" ({', '.join(keys)})") for about, keys in seen.items()) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", metavar="row", help=f"of {', '.join(ROWS)}; all by default")
    parser.add_argument("--rounds", type=int, default=9, help="at least 5 (default: %(default)s)")
    parser.add_argument("--update", action="store_true", help="write the table of results.json into README.md")
    arguments = parser.parse_args()
    if unknown := [row for row in arguments.rows if row not in ROWS]:
        parser.error(f"no row {', '.join(unknown)}; there are {', '.join(ROWS)}")
    if arguments.rounds < 5:
        parser.error("a median needs at least 5 rounds")
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    measured, about = {}, {"machine": harness.machine(), "date": datetime.now(timezone.utc).date().isoformat()}
    for key in arguments.rows or ROWS:
        measured[key] = harness.measure(ROWS[key](), arguments.rounds) | about
        print(table({key: measured[key]}), flush=True)
        kept = {name: measured.get(name) or kept.get(name) for name in ROWS if name in measured or name in kept}
        RESULTS.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    if arguments.update:
        before, rest = README.read_text(encoding="utf-8").split(BEGIN)
        text = before + BEGIN + "\n" + machines(kept) + "\n" + table(kept) + END + rest.split(END)[1]
        README.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
