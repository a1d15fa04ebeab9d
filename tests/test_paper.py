"""The paper's equations (4.4)-(4.9), with its errata, and the tabulated Appell-Hamel motion."""

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from conftest import signal
from refusals import refused
from scipy.optimize import brentq

import servoctl as sv
from servoctl.gallery import appell_hamel
from servoctl.methods.choice import as_method
from servoctl.model.equations import invariant_names

N = 20
P = cf.APPELL_HAMEL
FORMS = {"linear": "appell-hamel", "squared": "appell-hamel-squared"}
START = {"x": 0.0, "y": 0.0, "phi": 0.0, "theta": 0.0, "dphi": 1.0, "dtheta": 2.0}


def consistent_states():
    """(x, y, z, phi, theta, x', y', z', phi', theta') on the program and on the right branch, φ' off zero, (10, N)."""
    rng = np.random.default_rng(1976)
    x, y, phi, theta, dphi, dtheta = rng.uniform(-3.0, 3.0, (6, N))
    dphi += np.sign(dphi)
    sine, cosine = np.sin(theta), np.cos(theta)
    dx = P["a"] * dphi * cosine - P["rho"] * dtheta * sine
    dy = P["a"] * dphi * sine + P["rho"] * dtheta * cosine
    return np.array([x, y, -P["b"] * phi, phi, theta, dx, dy, -P["b"] * dphi, dphi, dtheta])


def derived(model, states):
    """γ'' of the derived rows, (5, N)."""
    f = model.function("ode")
    return np.array([f(0.0, state, model.p)[5:10] for state in states.T]).T


def paper_system(state, residuals):
    """The matrix and the right side of residuals that are affine in the five accelerations."""
    rest = residuals(state, np.zeros(5))
    columns = [residuals(state, unit) - rest for unit in np.eye(5)]
    return np.array(columns).T, -rest


def rows_4_9(state, accelerations):
    return cf.paper_4_9(state[4], *state[[5, 6, 8, 9]], accelerations)


def rows_4_8(state, accelerations):
    """(4.8) with the constraints (4.6) and (4.5)."""
    d2x, d2y, d2z, d2phi, d2theta = accelerations
    by_4_6 = cf.paper_4_6(state[4], *state[[5, 6, 8, 9]], d2phi, d2theta)
    constraints = [d2x - by_4_6[0], d2y - by_4_6[1], d2z + P["b"] * d2phi]
    return np.concatenate([cf.paper_4_8(state[4], *state[[5, 6, 8]], accelerations), constraints])


def worst(difference, size):
    return np.max(np.abs(difference) / (1.0 + np.abs(size).max(axis=0)))


@pytest.fixture(params=FORMS)
def model(request, gallery_model):
    return gallery_model(FORMS[request.param])


@pytest.fixture(scope="module")
def run(gallery_model):
    model = gallery_model("appell-hamel")
    return sv.simulate(model, model.start(**START), (0.0, 2.0), sv.methods.Adaptive(rtol=1e-12, atol=1e-13))


def test_random_states_satisfy_the_program(model):
    states = consistent_states()
    residuals = [model.function("invariants")(0.0, state, model.p) for state in states.T]
    assert np.max(np.abs(residuals[0][: len(invariant_names(model))])) < 1e-13
    assert cf.paper_4_4(states[4], *states[[5, 6, 8, 9]]) == pytest.approx(np.zeros((2, N)), abs=1e-13)


def test_derived_rows_satisfy_4_6(model):
    states = consistent_states()
    acceleration = derived(model, states)
    printed = cf.paper_4_6(states[4], *states[[5, 6, 8, 9]], *acceleration[3:])
    assert worst(acceleration[:2] - printed, acceleration) < 1e-12


@pytest.mark.parametrize("equations", [rows_4_8, rows_4_9])
def test_derived_rows_satisfy_4_8_and_4_9(equations, model):
    states = consistent_states()
    acceleration = derived(model, states)
    residuals = np.array([equations(state, a) for state, a in zip(states.T, acceleration.T, strict=True)]).T
    assert worst(residuals, acceleration) < 1e-12


@pytest.mark.parametrize("equations", [rows_4_8, rows_4_9])
def test_the_paper_as_a_linear_system_gives_the_same_accelerations(equations, model):
    states = consistent_states()
    solutions = np.array([np.linalg.solve(*paper_system(state, equations)) for state in states.T]).T
    assert worst(derived(model, states) - solutions, solutions) < 1e-12


def test_both_forms_of_the_program_have_the_same_motion_on_the_right_branch(gallery_model):
    states = consistent_states()
    linear, squared = (derived(gallery_model(name), states) for name in FORMS.values())
    assert worst(linear - squared, linear) < 1e-12


def test_equations_hold_away_from_the_default_parameters(gallery_model):
    other = {"m": 1.7, "M": 0.6, "I_x": 0.31, "I_y": 0.4, "a": 0.8, "b": 0.35, "rho": 0.45, "g": 1.62}
    model = gallery_model("appell-hamel").with_parameters(**other)
    theta, dphi, dtheta = 0.7, -1.3, 2.1
    rates = cf.appell_hamel_rates(np.array([0, 0, 0, 0, theta, dphi, dtheta]), other)
    state = np.concatenate([[0.0, 0.0, 0.0, 0.0, theta], rates[:5]])
    assert model.function("ode")(0.0, state, model.p)[8:10] == pytest.approx(rates[5:], rel=1e-13)


# errata --------------------------------------------------------------------------------------------------------------


def test_the_fourth_row_of_4_9_fails_as_printed(gallery_model):
    states = consistent_states()
    theta, dx, dy, dphi, dtheta = states[[4, 5, 6, 8, 9]]
    acceleration = derived(gallery_model("appell-hamel"), states)
    along = np.cos(theta) * dx + np.sin(theta) * dy
    swapped = P["rho"] * np.sin(theta) * np.cos(theta) * dy / along  # times θ' in print, times θ'' in (4.6)
    printed = cf.paper_4_9(theta, dx, dy, dphi, dtheta, acceleration)[3] + swapped * (acceleration[4] - dtheta)
    assert np.median(np.abs(printed)) > 1e-2 and np.sum(np.abs(printed) > 1e-3) >= N - 1


@pytest.mark.parametrize("coefficient", ["printed", "right"])
def test_the_coefficient_of_4_7_does_not_matter(coefficient, gallery_model):
    mechanism, program = appell_hamel()
    p, q = mechanism.parameters, mechanism.q
    _, _, _, dphi, dtheta = q.d(1)
    c = -2 * p.I_x + 3 * p.I_y + p.a**2 * p.M if coefficient == "printed" else -p.I_x + 2 * p.I_y + p.a**2 * p.M
    accelerations = ca.vertcat(*q.d(2))
    S = ca.dot(ca.vertcat(p.m, p.m, p.m, p.I_y + p.a**2 * p.M, p.I_x), accelerations**2) / 2  # (4.7)
    S += c * dphi**2 * dtheta**2 / 2
    again = sv.derive(sv.Mechanism(q, gibbs=S, potential=-p.m * p.g * q.d(0)[2], parameters=p), program)
    states = consistent_states()
    reference = derived(gallery_model("appell-hamel"), states)
    assert worst(derived(again, states) - reference, reference) < 1e-13


def test_4_7_read_with_velocities_where_it_means_accelerations_is_refused():
    mechanism, program = appell_hamel()
    p, q = mechanism.parameters, mechanism.q
    accelerations, rates = ca.vertcat(*q.d(2)[:3]), q.d(1)[3:]
    S = p.m * ca.dot(accelerations, accelerations) / 2 + (p.I_y + p.a**2 * p.M) * rates[0] ** 2 / 2
    S += p.I_x * rates[1] ** 2 / 2  # the last two terms as printed
    with refused(sv.errors.SpecificationError, names=["dphi"]):
        sv.derive(sv.Mechanism(q, gibbs=S, potential=-p.m * p.g * q.d(0)[2], parameters=p), program)


# the motion ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["DOP853", "Radau", "RK4"])
def test_tabulated_states(method, gallery_model):
    model = gallery_model("appell-hamel")
    tolerances = {"step": 5e-4} if method == "RK4" else {"rtol": 1e-10, "atol": 1e-12}
    run = sv.simulate(
        model,
        model.start(**START),
        (0.0, 2.0),
        method=as_method(method, **tolerances),
        t_eval=list(cf.APPELL_HAMEL_STATES),
    )
    found = np.array([run[name] for name in ("x", "y", "z", "phi", "theta", "dphi", "dtheta")])
    printed = np.array(list(cf.APPELL_HAMEL_STATES.values())).T
    assert np.max(np.abs(found - printed)) < 1e-8


def test_the_wheel_stops_and_rolls_back(run):
    place = run.jet_names.index("dphi")
    stop = brentq(lambda t: run.at(t)[place], 0.6, 0.8, xtol=1e-13)
    assert stop == pytest.approx(cf.WHEEL_STOPS, abs=1e-10)
    assert run["dphi"][-1] < -1.0


def test_energy_is_conserved(run):
    energy = run["energy"]
    assert np.max(np.abs(energy - energy[0])) < 1e-11 * np.ptp(P["m"] * P["g"] * run["z"])


def test_the_string_pulls_as_the_particle_needs(run):
    reference = cf.appell_hamel(run.t[::100])
    assert run["tension"][::100] == pytest.approx(reference["tension"], rel=1e-10)


def test_the_ideal_reaction_does_no_work(gallery_model, run):
    model = gallery_model("appell-hamel")
    for k in range(0, len(run.t), 100):
        reaction = list(signal(model, "reaction", run.t[k], run.jets[:, k]).values())
        assert abs(np.dot(reaction, run.jets[5:10, k])) < 1e-9 * np.abs(reaction).max()
