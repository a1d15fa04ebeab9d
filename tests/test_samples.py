"""Paths through samples: what their rounding and their ends do to the derivatives that the actuation contains is said."""

import math
import warnings

import casadi as ca
import numpy as np
import pytest

import servoctl as sv
from servoctl.reduction.knots import Switches
from servoctl.reduction.samples import Samples

LENGTH = 6.0  # s
ROUNDED = 1e-4 / math.sqrt(12)  # the standard deviation of what rounding to four decimals leaves out


def pulled(path):
    """A mass of 1 kg on a path, pulled by a force: u = path''."""
    q = sv.coordinates("x")
    (x,) = q
    pull = sv.Mechanism(q, sv.particle(q, 1.0, x), actuators={"pull": x})
    return pull, sv.Program({"path": x - path(q.t)})


def said(path):
    """The warnings of `derive` for a mass on a path, as text."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sv.derive(*pulled(path))
    return [str(one.message) for one in caught]


def samples_of(path):
    """The `Samples` of the only spline in a path."""
    q = sv.coordinates("x")
    switches = Switches(q, {"path": q["x"] - path(q.t)}, ())
    times = switches.times(np.empty(0))
    ((argument, knots),) = switches.tables("path").items()
    return Samples(switches, np.empty(0), "path", argument, knots, (times[0], times[-1]))


def through(n, function, smoothness=2, ends="natural", decimals=None, law=lambda t: t):
    """The path through n samples of a function of a time law from 0 to LENGTH."""
    times = np.linspace(0.0, LENGTH, n)
    points = function(times) if decimals is None else function(times).round(decimals)
    return lambda t: sv.paths.spline(law(t), times, points, smoothness=smoothness, ends=ends)


def at_rest(t):
    """From 0 to 5 with four derivatives zero at both ends: the polynomial S9."""
    s = t / LENGTH
    return 5.0 * s**5 * (126 - 420 * s + 540 * s**2 - 315 * s**3 + 70 * s**4)


@pytest.mark.parametrize("n", [121, 1001, 20001])  # sums over pieces, and tables
@pytest.mark.parametrize("derivative", [2, 3, 4])
def test_noise_of_rounded_samples_has_the_size_of_rounding(n, derivative):
    noise, k = samples_of(through(n, np.sin, 4, decimals=4)).noise(derivative), derivative
    h = LENGTH / (n - 1)
    by_rounding = ROUNDED * math.sqrt(math.comb(2 * k, k)) / h**k  # of differences; the sine's derivatives are 0.7
    if by_rounding < 0.05:
        assert noise is None
    if by_rounding > 1.0:
        assert ROUNDED / 1.5 < noise.size < 1.5 * ROUNDED
        assert noise.part > 0.5


@pytest.mark.parametrize("ends", ["natural", "rest"])
@pytest.mark.parametrize("n", [40, 300])
@pytest.mark.parametrize("value", [0.0, -2.5])
def test_nothing_is_said_of_a_path_that_stays(value, n, ends):
    assert said(through(n, lambda t: np.full_like(t, value), 4, ends)) == []


@pytest.mark.parametrize("law", ["time", "there", "back"])
def test_fewer_samples_as_proposed_give_the_force(law):
    laws = {
        "time": lambda t: t,
        "there": lambda t: sv.paths.rest_to_rest(t, 0.0, LENGTH, duration=2.0, smoothness=6),
        "back": lambda t: sv.paths.rest_to_rest(t, LENGTH, 0.0, duration=2.0, smoothness=6),
    }
    path = through(4001, at_rest, 4, "rest", 4, laws[law])
    (warning,) = said(path)
    noise = samples_of(path).noise(2)
    assert f"one in {noise.stride} samples" in warning
    times = np.append(np.linspace(0.0, LENGTH, 4001)[: -noise.stride : noise.stride], LENGTH)
    fewer, exact = (
        pulled(lambda t, points=points: sv.paths.spline(laws[law](t), times, points, smoothness=4))
        for points in (at_rest(times).round(4), at_rest(times))
    )
    forces = []
    for scene in (fewer, exact):
        model = sv.derive(*scene)
        forces.append(sv.simulate(model, model.start(), (0.0, 2.0), t_eval=np.linspace(0.0, 2.0, 201))["pull"])
    assert np.abs(forces[0] - forces[1]).max() < 0.1 * np.ptp(forces[1])


@pytest.mark.parametrize(
    "path",
    [
        through(10001, np.sin),
        through(10001, at_rest, 4, "rest"),
        through(30, lambda t: np.sin(2 * t)),
        through(36, lambda t: np.random.default_rng(3).normal(size=t.size), ends="rest"),  # via points
        through(1001, lambda t: 2.0 * t),  # whose second derivative is zero but for rounding
        through(1001, lambda t: 0.0 * t + 1.0),
        through(25, np.sin, ends="rest"),
        lambda t: sv.paths.rest_to_rest(t, 0.0, 1.0, LENGTH),
    ],
    ids=["sine", "from rest to rest", "thirty", "via points", "line", "constant", "few", "polynomial"],
)
def test_smooth_samples_and_via_points_are_taken_without_a_word(path):
    assert said(path) == []


def test_ends_at_rest_of_samples_in_motion_are_told_and_natural_ends_fit():
    (warning,) = said(through(2001, np.sin, ends="rest"))
    assert "'natural' and smoothness=2" in warning
    path = through(2001, np.sin, ends="natural")
    assert said(path) == []
    model = sv.derive(*pulled(path))
    run = sv.simulate(model, model.start(), (0.0, LENGTH))
    inside = (run.t > 0.1) & (run.t < LENGTH - 0.1)
    assert np.abs(run["pull"] + np.sin(run.t))[inside].max() < 1e-5


@pytest.mark.parametrize("k, n", [(2, 200), (2, 3001), (4, 401), (6, 101)])
def test_a_motion_that_is_brisk_at_its_start_fits_its_samples(k, n):
    def decay(t):
        return np.exp(-t / 0.1)

    brisk, turned = samples_of(through(n, decay, 2 * k - 2)), samples_of(through(n, lambda t: decay(6 - t), 2 * k - 2))
    assert brisk.steepness(k) < 3.0
    assert turned.steepness(k) < 3.0
    assert samples_of(through(n, decay, 2 * k - 2, "rest")).steepness(k) > 5.0


@pytest.mark.parametrize("n", [32, 40, 60])
def test_ends_that_make_all_of_a_spline_ring_are_told_as_ends(n):
    (warning,) = said(through(n, np.sin, 10, "rest"))
    assert "does not fit its samples at its ends" in warning
    assert said(through(n, np.sin, 10, "natural")) == []


def test_more_samples_are_proposed_where_no_fewer_are_calm():
    (warning,) = said(through(40, lambda t: np.tanh(5 * (t - 3)), ends="rest"))
    assert "pass more samples" in warning
    assert said(through(120, lambda t: np.tanh(5 * (t - 3)), ends="rest")) == []


@pytest.mark.parametrize("k", [2, 4, 6])
def test_the_proposed_smoothness_of_natural_ends_is_the_least_that_fits(k):
    fitting, lower = (samples_of(through(101, np.sin, s)).steepness(k) for s in (2 * k - 2, max(2 * k - 4, 1)))
    assert fitting < 1.0
    assert k == 2 or lower > 3.0


def test_a_path_with_parameters_of_several_residuals_warns_once():
    times = np.linspace(0.0, LENGTH, 3001)
    points = np.column_stack([np.sin(times), np.cos(times)]).round(4)
    q, p = sv.coordinates("x z"), sv.parameters(size=2.0, T=LENGTH)
    path = p.size * sv.paths.spline(q.t / p.T * LENGTH, times, points, smoothness=4, ends="natural")
    mass = sv.Mechanism(q, sv.particle(q, 1.0, ca.vertcat(*q)), actuators={"across": q["x"], "up": q["z"]}, parameters=p)
    with pytest.warns(RuntimeWarning, match="path in 'X', 'Z' do not determine its derivative 2") as caught:
        sv.derive(mass, sv.Program({"X": q["x"] - path[0], "Z": q["z"] - path[1]}))
    assert len(caught) == 1
