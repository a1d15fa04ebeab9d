"""Errors of modelling at other parameters: a power law through measured ones, and how far it holds."""

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from servoctl.values import frozen

CONCLUSIVE = 2.0  # factor up to which a prediction counts as conclusive
FURTHEST = 1.0  # distance outside the measured values, in half-widths of their range of logarithms
ALIKE = 0.98  # cosine between courses in time of errors that differ by a factor alone
SPREAD_FACTOR = 4.0  # times the largest difference between a case and what the others predict for it
LARGEST_SPREAD = 700.0  # of a spread whose exponential is a double
MOST_LEVERAGE = 1.0 - 1e-9  # of a case without which the others determine no law


@frozen(repr=False)
class Prediction:
    """An error at parameters that were not measured; made by `Levels.predict`.

    Attributes
    ----------
    value : float
        NaN where the cases determine no law.
    low, high : float
        The interval in which it lies, if the law holds there as well as between the measured cases.
    conclusive : bool
        Whether low and high are within a factor 2 of the value.
    exponents : dict of str to float
        e in error ~ parameterᵉ, by parameter.
    message : str
        What the law rests on; where the prediction is inconclusive, what to do.
    """

    value: float
    low: float
    high: float
    conclusive: bool
    exponents: Mapping[str, float] = field(default_factory=dict)
    message: str = ""

    def __repr__(self):
        law = " · ".join(f"{name}^{e:.2f}" for name, e in self.exponents.items())
        verdict = "conclusive" if self.conclusive else "inconclusive"
        lines = [f"Prediction, {verdict}: {self.value:.3g}, from {self.low:.3g} to {self.high:.3g}"]
        return "\n".join(lines + ([f"  error ~ {law}"] if law else []) + [f"  {self.message}"])


def power_law(cases, errors, at, floor, likeness=1.0):
    """The error at parameters from errors at others: error = c Π pᵢ^eᵢ by least squares in logarithms.

    Each case in turn is predicted from all others. Four times the largest of these differences, in ln(error), is the
    uncertainty between the measured cases. Outside of them it grows like the square of the distance from their middle,
    as the curvature of a law that is no power law does.

    Parameters
    ----------
    cases : (N, k) array
        Parameters of the measured cases.
    errors : (N,) array
    at : dict of str to float
        The k parameters by name, in the order of the columns.
    floor : float
        Uncertainty of the measured errors.
    likeness : float
        Smallest cosine between courses of the errors in time: those that follow one law differ by a factor alone.

    Returns
    -------
    Prediction
    """
    if len(errors) and np.all(errors <= floor):
        return _vanishing(cases, np.array(list(at.values())), floor)
    problem = _why_no_law(cases, errors, at, floor, likeness)
    if problem:
        return Prediction(np.nan, 0.0, np.inf, conclusive=False, message=problem)
    x, place, half = _centred(np.log(cases), np.log(list(at.values())))
    basis = np.column_stack([np.ones(len(x)), x])
    inverse = np.linalg.pinv(basis)
    law, leverage = inverse @ np.log(errors), np.diag(basis @ inverse)
    left_out = (np.log(errors) - basis @ law) / (1.0 - leverage)
    outside = max(np.abs(place).max() - 1.0, 0.0)
    spread = (SPREAD_FACTOR * np.abs(left_out).max() + floor / errors.min()) * (1.0 + outside) ** 2
    factor = float(np.exp(min(spread, LARGEST_SPREAD))) if outside <= FURTHEST else np.inf
    value, conclusive = float(np.exp(law @ [1.0, *place])), factor <= CONCLUSIVE
    message = _basis_of(len(errors), np.exp(np.abs(left_out).max()), outside, conclusive)
    exponents = dict(zip(at, (law[1:] / half).tolist(), strict=True))
    return Prediction(value, value / factor, value * factor, conclusive, exponents, message)


def _centred(x, place):
    """Points (N, k) and a place (k,) from the middle of the points' range, in half-widths; and these (k,)."""
    low, high = x.min(axis=0), x.max(axis=0)
    half = (high - low) / 2
    return (x - (low + high) / 2) / half, (place - (low + high) / 2) / half, half


def _why_no_law(cases, errors, at, floor, likeness):
    """Why the cases determine no law that could be checked; empty if they do."""
    if np.any(cases <= 0) or min(at.values()) <= 0:
        return "A power law needs positive parameters: measure cases of one sign, or the case itself."
    if np.any(errors <= floor):
        return "Some of the errors vanish, and others do not: measure cases on one side, or the case itself."
    if likeness < ALIKE:
        return "The errors of the cases have different courses in time, as vibrations do: measure the case itself."
    needed = len(at) + 2
    if len(cases) < needed or np.any(np.ptp(cases, axis=0) == 0):
        return f"A law in {', '.join(at)} is checked by at least {needed} cases in which each varies: measure more."
    basis = np.column_stack([np.ones(len(cases)), np.log(cases)])
    if np.linalg.matrix_rank(basis) < len(at) + 1:
        return f"{', '.join(at)} vary together: measure cases in which each varies by itself."
    if np.diag(basis @ np.linalg.pinv(basis)).max() > MOST_LEVERAGE:
        return f"One case alone decides about {', '.join(at)}: measure more cases."
    return ""


def _vanishing(cases, at, floor):
    inside = bool(np.all((at >= cases.min(axis=0)) & (at <= cases.max(axis=0))))
    where = "" if inside else ", and these parameters lie outside: measure the case itself"
    message = f"All {len(cases)} measured errors are below their uncertainty{where}."
    return Prediction(0.0, 0.0, floor if inside else np.inf, conclusive=inside, message=message)


def _basis_of(count, factor, outside, conclusive):
    """What a prediction rests on, and what to do where that is too little."""
    message = f"Each of {count} cases follows from the others within a factor {factor:.3g}"
    if outside > 0:
        message += f"; the parameters lie {outside:.2g} half-widths outside of them"
    return message + ("." if conclusive else ": measure cases nearer to the parameters.")
