"""Run many random mechanisms through the package and the reference: `python tests/adversary/run.py --cases 10000`.

Findings are saved as text, one file for each, named by seed; `--case FILE` or `--seed N --cases 1` runs one again.
"""

import argparse
import json
import os
import sys
from collections import Counter
from pathlib import Path

os.environ.setdefault("SERVOCTL_COMPILER", "none")  # a case is evaluated too few times to be worth compiling
os.environ.setdefault("SERVOCTL_MEMO", "none")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # matrices are small: threads only wait for each other
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2])]

from judge import judge  # noqa: E402
from machines import from_text, seeded  # noqa: E402


def _one(seed):
    case = seeded(seed)
    return seed, case, judge(case)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first case; the others follow")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("findings"), help="folder of findings")
    parser.add_argument("--case", type=Path, help="one saved case")
    options = parser.parse_args()
    if options.case:
        saved = json.loads(options.case.read_text())
        print(judge(from_text(json.dumps(saved["case"]))))
        return 0
    seeds, counts, words = range(options.seed, options.seed + options.cases), Counter(), {}
    for seed, case, verdict in _verdicts(seeds, options.jobs):
        counts[verdict.outcome] += 1
        for word in set(case.kinds):
            words.setdefault(word, Counter())[verdict.outcome.split(":")[0]] += 1
        if verdict.wrong:
            options.out.mkdir(parents=True, exist_ok=True)
            content = {"seed": seed, "outcome": verdict.outcome, "detail": verdict.detail, "case": json.loads(case.as_text())}
            (options.out / f"{seed}.json").write_text(json.dumps(content, indent=1))
    table(counts, words)
    return 1 if any(outcome.startswith("wrong") for outcome in counts) else 0


def _verdicts(seeds, jobs):
    from tqdm import tqdm

    if jobs == 1:
        yield from map(_one, tqdm(seeds, unit="case"))
        return
    from concurrent.futures import ProcessPoolExecutor

    with ProcessPoolExecutor(jobs) as pool:
        yield from tqdm(pool.map(_one, seeds, chunksize=4), total=len(seeds), unit="case")


def table(counts, words):
    """Print how cases ended, in all and by what they contain."""
    for outcome, count in sorted(counts.items(), key=lambda item: (item[0].startswith("wrong"), -item[1])):
        print(f"{count:7d}  {outcome}")
    print(f"\n{'':22s}{'right':>8s}{'refused rightly':>17s}{'wrong':>8s}")
    for word, ends in sorted(words.items()):
        print(f"{word:22s}{ends['right']:8d}{ends['refused rightly']:17d}{ends['wrong']:8d}")


if __name__ == "__main__":
    sys.exit(main())
