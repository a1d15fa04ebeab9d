"""The result of a verification: numbers, their limits, and a verdict."""

from dataclasses import field

import numpy as np

from servoctl.markup import Detailed, digits
from servoctl.values import frozen

PASSED, FAILED, INCONCLUSIVE = "passed", "failed", "inconclusive"
CHECK = ("check, relative", "value", "limit", "", "")
WORDS = {
    "samples": "samples that are not finite or out of order",
    "signals": "stored signals against those of the samples",
    "balance": "balance of the full mechanism under the actuation",
    "segments": "states after the motion was integrated from each sample to the next",
    "energy": "energy against the integrated power",
    "higher jets": "jets above the order of the model",
    "switches": "states beyond the switches of their sides",
    "outside": "part of the ideal reaction outside the actuators' reach",
    "loop power": "energy gained less the work of all forces",
    "loop power halved": "the same with steps half as long",
    "loop constraints": "material constraints, values and rates",
    "loop limits": "inputs beyond their limits",
    "loop repeated": "all signals of the loop when it is run again",
}
RESIDUAL = "largest residual, derivatives included"


def within(value, limit):
    """Whether a number is "within" its limit or "beyond" it; "" without a limit."""
    return "" if limit is None else "within" if value <= limit else "beyond"


@frozen(repr=False)
class Verification(Detailed):
    """Errors of a run against the full mechanism, all of them relative.

    Attributes
    ----------
    numbers : dict of str to float
        "samples": number of samples that are not finite or out of order;
        "signals": largest difference of a stored signal from its value at the samples, relative to its size;
        "balance": what the run's accelerations and actuation leave of the mechanism's balance, relative to its terms;
        "segments": largest difference of the state from the one integrated from the sample before;
        "energy": largest difference of the energy gained from the work of all forces;
        "higher jets": largest error of jets above the order of the model, relative to their sizes;
        "switches": largest relative change of a state that leads it back to its side of kinks and switches;
        "outside": part of an ideal reaction that the mechanism's actuators cannot exert;
        "residual NAME": largest residual at any level, as a relative change of the jets that would remove it.
    failures : tuple of str
        Names of numbers that exceed their limits.
    notes : tuple of str
        Checks that do not apply, and why.
    limits : dict of str to float
        Largest value of each number that passes.
    doubts : tuple of str
        What could not be checked, why, and what to do.
    remarks : tuple of str
        What else a reader should know, such as a first transient; the first of them is printed.
    """

    numbers: dict
    failures: tuple = ()
    notes: tuple = ()
    limits: dict = field(default_factory=dict)
    doubts: tuple = ()
    remarks: tuple = ()

    @property
    def verdict(self):
        """One of "failed" (a number exceeds its limit), "inconclusive" (something was not checked), and "passed"."""
        return FAILED if self.failures else INCONCLUSIVE if self.doubts else PASSED

    @property
    def passed(self):
        """Whether everything was checked and is within its limit."""
        return self.verdict == PASSED

    def _tables(self):
        return [(CHECK, self.rows())], (*self.remarks[:1], *self.doubts, *self.notes)

    def rows(self):
        """For each number its name, value, limit, whether it is "within" or "beyond" that, and what it is: texts."""
        return [
            (name, digits(value, 2), digits(limit, 2), within(value, limit), WORDS.get(name, RESIDUAL))
            for name, value in self.numbers.items()
            for limit in [self.limits.get(name)]
        ]

    def _lines(self, full):
        residuals = {k: v for k, v in self.numbers.items() if k.startswith("residual ")}
        worst = max(residuals, key=lambda key: np.nan_to_num(residuals[key], nan=np.inf), default=None)
        said = {FAILED: f"FAILED: {', '.join(self.failures)}"}.get(self.verdict, self.verdict)
        checks = [key for key in WORDS if key in self.numbers] + [key for key in residuals if full or key == worst]
        checks.sort(key=lambda key: key not in self.failures)  # what failed comes first
        first = [f"  {text}" for text in (*self.remarks[: None if full else 1], *self.doubts, *self.notes)]
        return [f"Verification: {said}", *first, *map(self._line, checks)]

    def _line(self, key):
        limit = self.limits.get(key, np.inf)
        allowed = f"limit {limit:7.1e}" if np.isfinite(limit) else "no limit     "
        words = WORDS.get(key) or f"{RESIDUAL} ({key.removeprefix('residual ')})"
        return f"  {self.numbers[key]:7.1e}, {allowed}: {words}{'  FAILED' * (key in self.failures)}"


def judged(numbers, limits, notes=(), doubts=()):
    """The verification of numbers with their limits; a number that is NaN fails."""
    failures = tuple(key for key, value in numbers.items() if not value <= limits[key])
    return Verification(numbers, failures, tuple(notes), limits, tuple(doubts))


def largest(values):
    """The largest magnitude; infinite if a value is NaN."""
    most = float(np.abs(values).max(initial=0.0))
    return np.inf if np.isnan(most) else most


def numbers(value, dimensions):
    """An array of real numbers from what a run holds; None if it is none of so many dimensions."""
    try:
        array = np.asarray(value)
        array = array if array.dtype.kind == "c" else array.astype(float)
    except (TypeError, ValueError):
        return None
    return array if array.ndim == dimensions and array.dtype.kind == "f" else None
