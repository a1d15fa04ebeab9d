"""Ratios against peers in one run: rounds interleaved, answers compared, medians of ratios.

A machine's speed drifts, so seconds from two runs cannot be compared. Here each peer is timed next to us in every round
(ours, peer, ours, peer, ...), and reported is the median over rounds of peer time / our time. A wrong answer fails.
"""

import gc
import importlib.util
import math
import os
import statistics
import subprocess
import time
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from importlib import metadata

from servoctl.codegen import compiler
from servoctl.study import table as study

os.environ["SERVOCTL_MEMO"] = "none"  # what is timed as derived is derived
compiler.choice = ContextVar("compiled", default=True)  # and what is timed as compiled is compiled at its first use

SAMPLE = 0.02  # s: a sample repeats a call for as long as this
TRIALS, TRIAL = 7, 0.001  # samples, and their length [s], by which `fastest` compares settings


@dataclass(frozen=True)
class Missing:
    """A peer that is not timed, and why."""

    why: str


@dataclass(frozen=True)
class Timed:
    """What a callable returns that has taken its own time, as in another process."""

    seconds: float
    answer: object


@dataclass(frozen=True)
class Row:
    """One comparison.

    Parameters
    ----------
    title : str
    ours : callable
        Takes nothing, returns an answer or `Timed`.
    peers : dict of str to callable or Missing
    error : callable
        The error of an answer, a number; NaN is an error too.
    within : float
        Largest error with which an answer counts as right.
    bars : dict of str to float
        Least ratio peer / ours that is aimed at, by peer; a peer without one is reported only.
    looser : dict of str to float
        Largest errors of peers that cannot come as near as `within`.
    """

    title: str
    ours: Callable
    peers: dict
    error: Callable
    within: float
    bars: dict = field(default_factory=dict)
    looser: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Limit:
    """One number with an upper bound: a count, or the median of samples.

    Parameters
    ----------
    title : str
    value : callable
        Takes the number of rounds, returns the samples.
    bound : float
    unit : str
    """

    title: str
    value: Callable
    bound: float
    unit: str = ""


def installed(*modules):
    """Whether these can be imported."""
    return all(importlib.util.find_spec(module) for module in modules)


def fastest(make, settings, error, within):
    """The fastest of `make(*setting)` among the settings whose answers are within an error, or `Missing`."""
    calls = [make(*setting) for setting in settings]
    exact = [call for call in calls if error(_answer(call())) <= within]
    if not exact:
        return Missing(f"no setting reaches {within:.0e}")
    return min(exact, key=lambda call: min(_sample(call, _number(call, TRIAL)) for _ in range(TRIALS)))


def measure(row, rounds):
    """Measure a `Row` or a `Limit`.

    Returns a dict with "title", "rounds" and "lines", one for each peer (or for the limit).
    """
    lines = _limit(row, rounds) if isinstance(row, Limit) else _ratios(row, rounds)
    return {"title": row.title, "rounds": rounds, "lines": lines}


def _limit(row, rounds):
    samples = row.value(rounds)
    value = statistics.median(samples)
    low, high = _quartiles(samples)
    return [{"value": value, "low": low, "high": high, "unit": row.unit, "bar": row.bound, "met": value <= row.bound}]


def _ratios(row, rounds):
    if isinstance(row.ours, Missing):
        return [{"peer": name, "bar": row.bars.get(name), "missing": row.ours.why, "met": None} for name in row.peers]
    calls = {"": row.ours} | {name: call for name, call in row.peers.items() if not isinstance(call, Missing)}
    errors, numbers = {}, {}
    for name, call in calls.items():  # the warm-up, and the answers
        errors[name] = float(row.error(_answer(call())))
        numbers[name] = _number(call, SAMPLE)
    times = {name: ([], []) for name in calls if name}
    gc.disable()
    try:
        for _ in range(rounds):
            for name, (ours, theirs) in times.items():
                ours.append(_sample(calls[""], numbers[""]))
                theirs.append(_sample(calls[name], numbers[name]))
    finally:
        gc.enable()
    return [_line(row, name, errors, times.get(name)) for name in row.peers]


def _line(row, name, errors, times):
    line = {"peer": name, "bar": row.bars.get(name)}
    if times is None:
        return line | {"missing": row.peers[name].why, "met": None}
    ratios = [b / a for a, b in zip(*times, strict=True)]
    ratio, (low, high) = statistics.median(ratios), _quartiles(ratios)
    ours, theirs = map(statistics.median, times)
    right = errors[""] <= row.within and errors[name] <= row.looser.get(name, row.within)
    line |= {"ratio": ratio, "low": low, "high": high, "seconds": theirs, "our_seconds": ours}
    line |= {"error": errors[name], "our_error": errors[""], "agree": right}
    return line | {"met": right and (line["bar"] is None or ratio >= line["bar"])}


def _answer(result):
    return result.answer if isinstance(result, Timed) else result


def _number(call, seconds):
    """How many calls take this long."""
    return max(1, math.ceil(seconds / max(_sample(call, 1), 1e-9)))


def _sample(call, number):
    start = time.perf_counter()
    for _ in range(number):
        result = call()
    seconds = (time.perf_counter() - start) / number
    return result.seconds if isinstance(result, Timed) else seconds


def _quartiles(samples):
    if len(samples) < 2:
        return samples[0], samples[0]
    first, _, third = statistics.quantiles(samples, n=4, method="inclusive")
    return first, third


def machine():
    """What the numbers were measured on: that of a study, with gcc's version and those of the peers."""
    peers = {name: name for name in ("heyoka", "sympy", "control", "mujoco", "numba")}
    peers |= {"pin": "pinocchio", "drake": "pydrake"}
    about = study.machine()
    about["versions"] |= {name: metadata.version(name) for name, module in peers.items() if installed(module)}
    return about | {"compiler": _first_line("gcc", "--version")}


def _first_line(*command):
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[0]
    except (OSError, subprocess.CalledProcessError):
        return "none"
