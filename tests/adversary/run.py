"""Run many random mechanisms through the package and the reference: `python tests/adversary/run.py --cases 10000`.

Findings are saved as text, one file for each, named by seed; `--case FILE` or `--seed N --cases 1` runs one again.
`--log FILE` keeps one line for each case as soon as it ends: the same command goes on after an interruption, and with
`--cases 0` it prints the counts so far. A case makes at most `judge.MOST_CALLS` calls.
"""

import argparse
import json
import os
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

os.environ.setdefault("SERVOCTL_COMPILER", "none")  # a case is evaluated too few times to be worth compiling
os.environ.setdefault("SERVOCTL_MEMO", "none")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: threads only wait for each other
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2])]

from judge import judge  # noqa: E402
from machines import from_text, seeded  # noqa: E402


def _one(seed, moved=False):
    start, drawn = time.process_time(), seeded(seed)
    case = seeded(seed, other=True) if moved else drawn
    return seed, case, judge(case, drawn if moved else None), time.process_time() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first case; the others follow")
    parser.add_argument("--moved", action="store_true", help="in other coordinates, compared with those of the seed")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("findings"), help="folder of findings")
    parser.add_argument("--log", type=Path, help="a line for each case; cases that it holds are not run again")
    parser.add_argument("--case", type=Path, help="one saved case")
    options = parser.parse_args()
    if options.case:
        saved = json.loads(options.case.read_text(encoding="utf-8"))
        print(judge(from_text(json.dumps(saved["case"]))))
        return 0
    done = _logged(options.log)
    seeds = [seed for seed in range(options.seed, options.seed + options.cases) if seed not in done]
    for seed, case, verdict, seconds in _verdicts(seeds, options.jobs, options.moved):
        line = {"seed": seed, "outcome": verdict.outcome, "kinds": sorted(set(case.kinds)), "seconds": round(seconds, 2)}
        done[seed] = line
        if options.log:
            with options.log.open("a") as file:
                file.write(json.dumps(line) + "\n")
        if verdict.wrong:
            options.out.mkdir(parents=True, exist_ok=True)
            content = {"seed": seed, "outcome": verdict.outcome, "detail": verdict.detail, "case": json.loads(case.as_text())}
            (options.out / f"{seed}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    counts = table(done.values())
    return 1 if any(outcome.startswith("wrong") for outcome in counts) else 0


def _logged(log):
    """The lines of a log by their seeds."""
    lines = log.read_text(encoding="utf-8").splitlines() if log and log.exists() else ()
    return {line["seed"]: line for line in map(json.loads, lines)}


def _verdicts(seeds, jobs, moved):
    from tqdm import tqdm

    one = partial(_one, moved=moved)
    if jobs == 1:
        yield from map(one, tqdm(seeds, unit="case"))
        return
    from concurrent.futures import ProcessPoolExecutor

    with ProcessPoolExecutor(jobs) as pool:
        yield from tqdm(pool.map(one, seeds, chunksize=4), total=len(seeds), unit="case")


def table(lines):
    """Print how cases ended, in all and by what they contain; return the counts of outcomes."""
    counts, words = Counter(), {}
    for line in lines:
        counts[line["outcome"]] += 1
        for word in line["kinds"]:
            words.setdefault(word, Counter())[line["outcome"].split(":")[0]] += 1
    for outcome, count in sorted(counts.items(), key=lambda item: (item[0].startswith("wrong"), -item[1])):
        print(f"{count:7d}  {outcome}")
    print(f"\n{'':22s}{'right':>8s}{'refused rightly':>17s}{'wrong':>8s}")
    for word, ends in sorted(words.items()):
        print(f"{word:22s}{ends['right']:8d}{ends['refused rightly']:17d}{ends['wrong']:8d}")
    return counts


if __name__ == "__main__":
    sys.exit(main())
