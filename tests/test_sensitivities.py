"""Derivatives of motions by parameters and initial values, against closed forms and differences."""

from dataclasses import replace
from functools import partial

import casadi as ca
import closed_forms as known
import numpy as np
import pytest
from refusals import refused
from scipy.integrate import trapezoid

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.gallery import gallery
from servoctl.model.equations import signal_groups

NUMBERS = {"m_trolley": 10.0, "m_hoist": 5.0, "m_load": 100.0, "g": 9.81}


@pytest.fixture(scope="module")
def crane(gallery_model):
    model = gallery_model("overhead-crane")
    return model, sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))


def crane_forces(t, m_trolley, m_hoist, m_load, g):
    """Forces of the crane (2, N) from its closed form, for complex numbers, too."""
    p = partial(known.rest_to_rest, t, start=(0.0, 4.0), end=(5.0, 2.0), duration=6.0, smoothness=4)
    x, z = ([p(k)[i] for k in range(5)] for i in range(2))
    lean = [-x[2 + j] for j in range(3)], [g * (j == 0) - z[2 + j] for j in range(3)]
    w = lean[0][0] / lean[1][0]
    dw = (lean[0][1] - w * lean[1][1]) / lean[1][0]
    d2w = (lean[0][2] - 2 * dw * lean[1][1] - w * lean[1][2]) / lean[1][0]
    rope = [z[0] * w, z[1] * w + z[0] * dw, z[2] * w + 2 * z[1] * dw + z[0] * d2w]
    length = np.sqrt(rope[0] ** 2 + z[0] ** 2)
    rate = (rope[0] * rope[1] + z[0] * z[1]) / length
    d2length = (rope[1] ** 2 + z[1] ** 2 + rope[0] * rope[2] + z[0] * z[2] - rate**2) / length
    tension = m_load * np.sqrt(lean[0][0] ** 2 + lean[1][0] ** 2)
    return np.array([m_trolley * (x[2] - rope[2]) + m_load * x[2], m_hoist * d2length - tension])


def test_forces_of_the_crane_by_four_parameters(crane):
    """The closed form is differentiated by a complex step, without rounding."""
    model, run = crane
    s = sv.sensitivity(run, to=list(NUMBERS))
    plan = crane_forces(run.t, **NUMBERS)
    assert np.abs(plan - [run["trolley"], run["hoist"]]).max() < 1e-9
    for name, value in NUMBERS.items():
        exact = crane_forces(run.t, **NUMBERS | {name: value + 1e-30j}).imag / 1e-30
        assert np.abs(exact - [s["trolley", name], s["hoist", name]]).max() < 1e-11
        h = 1e-4 * value
        ends = [model.with_parameters(**{name: value + d}) for d in (h, -h)]
        ends = [sv.simulate(m, m.start(guess={"l": 4.0}), (0.0, 8.0)) for m in ends]
        for of in ("trolley", "hoist"):
            difference = (ends[0][of] - ends[1][of]) / (2 * h)
            assert np.abs(difference - s[of, name]).max() < 1e-6 * max(1.0, np.abs(s[of, name]).max())


def test_extrema_of_the_crane(crane):
    model, run = crane
    s = sv.sensitivity(run, to="m_load")
    h = 0.01
    ends = [model.with_parameters(m_load=100.0 + d) for d in (h, -h)]
    ends = [sv.simulate(m, m.start(guess={"l": 4.0}), (0.0, 8.0)) for m in ends]
    for of in ("trolley", "hoist"):
        for side in (0, 1):
            difference = (ends[0].extrema(of)[side][1] - ends[1].extrema(of)[side][1]) / (2 * h)
            assert s.extrema(of)["m_load"][side] == pytest.approx(difference, abs=1e-8)


SCENES = ("appell-hamel", "mass-on-car-absolute", "winch-crane")


@pytest.mark.parametrize("name", SCENES)
def test_scenes_against_differences(name, gallery_model):
    """All jets and signals by all parameters and the held initial values; differences of order 4, from other starts."""
    scene, model = gallery[name], gallery_model(name)
    start = model.start(**scene.start, guess=scene.guess)
    method = None if model.flat else sv.methods.Taylor(rtol=1e-13, atol=1e-14)
    span, times = (0.0, 1.0), np.linspace(0.0, 1.0, 21)

    def run(m, **values):
        x = m.start(**scene.start, guess=scene.guess) if m.flat else m.start(**values, guess=start_guess)
        return sv.simulate(m, x, span, method, t_eval=times)

    start_guess = dict(zip(start.names, start.values, strict=True))
    motion = sv.simulate(model, start, span, method, t_eval=times)
    of = [*model.jet_names, *signal_groups(model.reduction)]
    s = sv.sensitivity(motion, of, [*model.numbers, *(n for n in start.held if n in model.state_names)])
    free = {n: start[n] for n in s.independent}
    for to in s.to:
        value, h = s.number(to), 1e-4 * (abs(s.number(to)) or 1.0)
        ends = []
        for k in (-2, -1, 1, 2):
            parameter = to in model.numbers
            other = model.with_parameters(**{to: value + k * h}) if parameter else model
            ends.append(run(other, **free | ({} if parameter else {to: value + k * h})))
        for signal in of:
            a, b, c, d = (end[signal] for end in ends)
            difference = (a - 8 * b + 8 * c - d) / (12 * h)
            size = np.abs(motion[signal]).max() / (abs(value) or 1.0) + np.abs(difference).max() + 1e-4
            assert np.abs(s[signal, to] - difference).max() < 1e-7 * size, (signal, to)


@pytest.mark.parametrize("method", ["DOP853", "Taylor", "RadauIIA", "RK8"])
def test_a_damped_mass(method):
    """x = v0 m/c (1 - e^(-c t/m)), a plant without inputs."""
    p = sv.parameters(m=2.0, c=0.5)
    q = sv.coordinates("x")
    (x,) = q
    plant = sv.plant(sv.Mechanism(q, gibbs=sv.particle(q, p.m, x), forces={"x": -p.c * q.d(1)[0]}, parameters=p))
    run = sv.simulate(plant, {"x": 1.0, "dx": 3.0}, (0.0, 4.0), method)
    s = sv.sensitivity(run, ["x", "dx", "d2x"], ["m", "c", "x", "dx"])
    t, decay = run.t, np.exp(-run.t / 4)
    assert s.independent == ("x", "dx")
    assert s["x", "x"] == pytest.approx(np.ones(len(t)), abs=1e-9)
    assert s["x", "dx"] == pytest.approx(4 * (1 - decay), abs=1e-9)
    assert s["dx", "dx"] == pytest.approx(decay, abs=1e-9)
    assert s["x", "m"] == pytest.approx(3 / 0.5 * (1 - decay) - 3 * t / 2 * decay, abs=1e-8)
    assert s["dx", "c"] == pytest.approx(-3 * t / 2 * decay, abs=1e-8)
    assert s["d2x", "c"] == pytest.approx(-3 / 2 * decay * (1 - t / 4), abs=1e-8)


SWITCHED_OFF = sv.paths.polynomials([0.0, 1.0, 2.0], [[1.0, 0.0]])  # 1 until t = 1, then 0


def test_a_force_that_ends_at_a_parameter():
    """x'' = F until T: x = F T (t - T/2) afterwards, so that ∂x/∂T = F (t - T) and ∂x'/∂T = F."""
    p = sv.parameters(T=1.3, F=2.0)
    q = sv.coordinates("x")
    (x,) = q
    force = {"x": p.F * q.references(on=SWITCHED_OFF.at_rate(1 / p.T, 0.0)).on}
    plant = sv.plant(sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x), forces=force, parameters=p))
    for span in ((0.0, 3.0), (3.0, 0.0)):
        run = sv.simulate(plant, {"x": 0.0, "dx": 0.0}, span, "DOP853")
        s = sv.sensitivity(run, ["x", "dx"])
        after = (run.t > 1.3) if span[0] == 0.0 else (run.t < 1.3)
        sign = 1.0 if span[0] == 0.0 else -1.0
        assert s["dx", "T"][after] == pytest.approx(sign * 2.0, abs=1e-8)
        assert s["x", "T"][after] == pytest.approx(sign * 2.0 * (run.t[after] - 1.3), abs=1e-8)
        assert np.abs(s["dx", "T"][~after][:-1]).max() < 1e-9


SAMPLES = {"late": [1.0, 2.0, 3.0], "between": [0.7, 1.31, 2.0], "one": [2.5], "the first alone": [0.0], "the end": [3.0]}


@pytest.mark.parametrize("times", SAMPLES.values(), ids=SAMPLES)
@pytest.mark.parametrize("method", ["DOP853", "Taylor", "RadauIIA", "RK8"])
def test_samples_that_begin_after_the_start(method, times):
    """A damped mass, x = x0 + v0 m/c (1 - e^(-c t/m)), forwards and backwards: derivatives are those from its start."""
    p = sv.parameters(m=2.0, c=0.5)
    q = sv.coordinates("x")
    (x,) = q
    plant = sv.plant(sv.Mechanism(q, gibbs=sv.particle(q, p.m, x), forces={"x": -p.c * q.d(1)[0]}, parameters=p))
    for sign in (1.0, -1.0):
        run = sv.simulate(plant, {"x": 1.0, "dx": 3.0}, (0.0, sign * 3.0), method, t_eval=sign * np.array(times))
        s = sv.sensitivity(run, ["x", "dx"], ["m", "c", "x", "dx"])
        t, decay = run.t, np.exp(-run.t / 4)
        assert s["x", "x"] == pytest.approx(np.ones(len(t)), abs=1e-9) and s.number("dx") == 3.0
        assert s["x", "dx"] == pytest.approx(4 * (1 - decay), abs=1e-8)
        assert s["x", "m"] == pytest.approx(6 * (1 - decay) - 1.5 * t * decay, abs=1e-8)
        assert s["dx", "c"] == pytest.approx(-1.5 * t * decay, abs=1e-8)


@pytest.mark.parametrize("times", [[2.0, 3.0], [1.31], [0.5, 2.0]])
def test_a_knot_before_the_first_sample(times):
    """x'' = F until T, as above; a knot may lie between the start and the first sample, or between two samples."""
    p = sv.parameters(T=1.3, F=2.0)
    q = sv.coordinates("x")
    (x,) = q
    force = {"x": p.F * q.references(on=SWITCHED_OFF.at_rate(1 / p.T, 0.0)).on}
    plant = sv.plant(sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x), forces=force, parameters=p))
    run = sv.simulate(plant, {"x": 0.0, "dx": 0.0}, (0.0, 3.0), "DOP853", t_eval=times)
    s, after = sv.sensitivity(run, ["x", "dx"]), run.t > 1.3
    assert s["dx", "T"] == pytest.approx(np.where(after, 2.0, 0.0), abs=1e-8)
    assert s["x", "T"] == pytest.approx(np.where(after, 2.0 * (run.t - 1.3), 0.0), abs=1e-8)
    assert s["dx", "F"] == pytest.approx(np.minimum(run.t, 1.3), abs=1e-8)


def two_masses(path=lambda q: 0.5 * ca.sin(q.t)):
    """A driven mass with a second one, which the program leaves free, on a spring and a damper."""
    p = sv.parameters(k=5.0, d=0.4)
    x, y = q = sv.coordinates("x y")
    force = p.k * (x - y) + p.d * (q.d(1)[0] - q.d(1)[1])
    S = sv.particle(q, 1.0, x) + sv.particle(q, 2.0, y)
    mechanism = sv.Mechanism(q, S, actuators={"F": x}, forces=ca.vertcat(-force, force), parameters=p)
    return sv.derive(mechanism, sv.Program({"X": x - path(q)}))


@pytest.mark.parametrize("drift", [None, "project", 0.1])
def test_internal_motion_sampled_after_the_start(drift):
    """2 y'' = k (x - y) + d (x' - y') with x = sin(t)/2, against the same motion for complex k, d and y0."""
    model = two_masses()
    run = sv.simulate(model, model.start(y=0.1, dy=0.0), (0.0, 3.0), drift=drift, t_eval=[1.0, 2.0, 3.0])
    s = sv.sensitivity(run, ["y", "dy"], ["k", "d", "y", "dy"])

    def motion(k=5.0, d=0.4, y=0.1, dy=0.0):
        i = (k + 1j * d) / (k - 2 + 1j * d)  # of a forcing (k + d D)/2 e^(it): y = Im(i e^(it))/2, for complex numbers
        j = (k - 1j * d) / (k - 2 - 1j * d)
        part = [(i * (1j) ** n * np.exp(1j * run.t) - j * (-1j) ** n * np.exp(-1j * run.t)) / 4j for n in (0, 1)]
        at_0 = [(i - j) / 4j, (i + j) / 4]
        root = np.sqrt(0j + (d / 4) ** 2 - k / 2)
        r1, r2 = -d / 4 + root, -d / 4 - root
        c2 = (dy - at_0[1] - r1 * (y - at_0[0])) / (r2 - r1)
        c1 = y - at_0[0] - c2
        return [part[n] + c1 * r1**n * np.exp(r1 * run.t) + c2 * r2**n * np.exp(r2 * run.t) for n in (0, 1)]

    assert [run["y"], run["dy"]] == pytest.approx(np.real(motion()), abs=1e-7)
    for name, value in {"k": 5.0, "d": 0.4, "y": 0.1, "dy": 0.0}.items():
        h = 1e-4
        a, b, c, e = (np.real(motion(**{name: value + n * h})) for n in (-2, -1, 1, 2))
        exact = (a - 8 * b + 8 * c - e) / (12 * h)
        assert np.abs(exact - [s["y", name], s["dy", name]]).max() < 1e-9, name


def test_initial_values_that_follow_from_others(gallery_model):
    model = gallery_model("passive-arm")
    run = sv.simulate(model, model.start(q2=0.0, dq2=0.0), (0.0, 0.5))
    assert sv.sensitivity(run, to="q2").independent == ("q2", "dq2")
    with refused(SpecificationError, "q1", name="dq1"):
        sv.sensitivity(run, to=["q2", "dq2", "dq1"])


def test_what_is_refused(crane):
    model, run = crane
    with refused(NameUnknown, "trolly"):
        sv.sensitivity(run, of="trolly")
    with refused(NameUnknown, "mass"):
        sv.sensitivity(run, to="mass")
    with refused(SpecificationError, name="theta"):
        sv.sensitivity(run, to="theta")
    with refused(SpecificationError, "sv.sensitivity(run)"):
        sv.sensitivity(model)
    with refused(NameUnknown):
        sv.sensitivity(run)["trolley", "m"]


def test_derivatives_of_a_plan_of_the_plant_hold_its_inputs():
    model = two_masses(lambda q: q.references(X=sv.paths.rest_to_rest(0.0, 1.0, 2.0)).X)
    r = model.reduction
    plan = sv.relaxed(sv.plant(r.mechanism), r.program, (0.0, 2.0))
    s = sv.sensitivity(plan, "y", "k")
    ends = [plan.model.with_parameters(k=5.0 + h) for h in (-1e-3, 1e-3)]
    below, above = (sv.simulate(m, plan.start.values, (0.0, 2.0), t_eval=plan.t)["y"] for m in ends)
    assert np.abs((above - below) / 2e-3 - s["y", "k"]).max() < 1e-6 * np.abs(s["y", "k"]).max() + 1e-9


def test_what_it_prints_and_draws(crane):
    model, run = crane
    s = sv.sensitivity(run)
    assert len(s) == 8 and ("trolley", "g") in s and len(repr(s).splitlines()) <= 12
    axes = s.plot(units={"trolley": "N", "hoist": "N"})
    assert len(axes) == 2 and len(axes[0].lines) == 4
    assert axes[0].lines[2].get_ydata() == pytest.approx(s.change("m_load") * s["trolley", "m_load"])


def test_bounded_motions_against_differences():
    from test_bounded import aircraft, arm

    for model, span, names in ((arm(0.5), (0.0, 2.0), ("c", "d", "Gamma", "m")), (aircraft(), (0.0, 3.0), None)):
        times = np.linspace(*span, 23)[1:-1]
        names = names or list(model.numbers)
        run = sv.simulate(model, model.start(), span, sv.methods.Bounded(window=14.0, rtol=1e-11))
        within = [int(np.argmin(np.abs(run.t - t))) for t in times]
        of = [*model.jet_names, *model.actuators]
        s = sv.sensitivity(run, of, names)
        for to in names:
            h = 1e-3 * (abs(model.numbers[to]) or 1.0)
            ends = []
            for k in (-2, -1, 1, 2):
                other = model.with_parameters(**{to: model.numbers[to] + k * h})
                method = sv.methods.Bounded(window=14.0, rtol=1e-11)
                ends.append(sv.simulate(other, other.start(), span, method, t_eval=run.t[within]))
            for signal in of:
                a, b, c, d = (end[signal] for end in ends)
                difference = (a - 8 * b + 8 * c - d) / (12 * h)
                size = np.abs(run[signal]).max() / (abs(model.numbers[to]) or 1.0) + np.abs(difference).max() + 1e-4
                assert np.abs(s[signal, to][within] - difference).max() < 1e-6 * size, (signal, to)


def test_a_bounded_motion_has_no_free_initial_values():
    from test_bounded import arm

    model = arm(0.5)
    run = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded())
    with refused(SpecificationError, name="q2"):
        sv.sensitivity(run, to="q2")


BOUNDED_SAMPLES = {"between": [0.5, 1.0, 1.5], "one": [1.0], "late": [1.7, 2.0], "ends": [0.0, 2.0], "start": [0.0, 0.3]}


@pytest.mark.parametrize("times", BOUNDED_SAMPLES.values(), ids=BOUNDED_SAMPLES)
def test_samples_do_not_change_the_derivatives_of_a_bounded_motion(times):
    """Against the samples of the whole window, whose derivatives are compared with differences above."""
    from test_bounded import arm

    model = arm(0.5)
    full = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), t_eval=np.linspace(0.0, 2.0, 1001))
    whole = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded())
    run = sv.simulate(model, model.start(), (0.0, 2.0), sv.methods.Bounded(), t_eval=times)
    exact, s = (sv.sensitivity(one, ["q2", "torque"]) for one in (full, run))
    beyond = sv.sensitivity(whole, ["q2", "torque"])
    for pair in s.names:
        size = np.abs(exact[pair]).max() + 1e-9
        assert np.abs(np.interp(run.t, full.t, exact[pair]) - s[pair]).max() < 1e-5 * size
        at = [int(np.argmin(np.abs(whole.t - t))) for t in full.t]
        same = np.abs(whole.t[at] - full.t) < 1e-12
        assert same.sum() > 10 and np.abs(exact[pair] - beyond[pair][at])[same].max() < 1e-8 * size


def test_bounded_motions_whose_window_the_samples_do_not_tell():
    """y'' = k (y - x) has the bounded motion y = ∫ √k/2 e^(-√k |t - s|) x(s) ds; x has no knots."""
    p = sv.parameters(k=9.0)
    x, y = q = sv.coordinates("x y")
    S = sv.particle(q, 1.0, x) + sv.particle(q, 1.0, y)
    mechanism = sv.Mechanism(q, S, actuators={"F": x}, forces={"y": p.k * (y - x)}, parameters=p)
    model = sv.derive(mechanism, sv.Program({"X": x - (1 + ca.tanh(4 * (q.t - 3))) / 2}))
    span = (-3.0, 9.0)

    def run(**settings):
        return sv.simulate(model, model.start(t=span[0]), span, "bounded", **settings)

    u = np.linspace(-12.0, 12.0, 48001)
    both = [np.sqrt(k) / 2 * np.exp(-np.sqrt(k) * np.abs(u)) for k in (9.001, 8.999)]
    weights = (both[0] - both[1]) / 0.002
    for times in (None, [2.5, 8.0], [-2.0, 3.0, 9.0]):
        s = sv.sensitivity(run(t_eval=times), "y")
        near = np.abs(s.t - 3.0) < 6.0
        exact = [trapezoid(weights * (1 + np.tanh(4 * (t - u - 3))) / 2, u) for t in s.t[near]]
        assert s["y", "k"][near] == pytest.approx(exact, abs=1e-7)
    for times in ([2.5, 3.1], [3.0]):  # after which the program moves on, without a knot
        with refused(SpecificationError, samples=(times[0], times[-1])):
            sv.sensitivity(run(t_eval=times), "y")
    whole = run()
    assert len(sv.sensitivity(replace(whole, jets=1.0001 * whole.jets), "y")) == 1
    with refused(SpecificationError, samples=(whole.t[0], whole.t[-1])):
        sv.sensitivity(replace(whole, jets=1.004 * whole.jets), "y")
