"""LQR about a plan: Riccati equation, discretisation, weights, and the crane of the design."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scenes import CRANE

import servoctl as sv
from servoctl.control import lqr as lqr_module
from servoctl.control.lqr import weights
from servoctl.control.reference import Reference
from servoctl.control.sampling import discretised, exponentials
from servoctl.gallery import gallery

GUST = {"theta": sv.disturbances.gust(60.0, 2.0, 2.5)}
WEIGHTS = {"Q": [1e3] * 3 + [1e2] * 3, "R": 1e-3}


def load_error(run):
    return np.hypot(run.residual["X"][0], run.residual["Z"][0])


def heavier(plan, law):
    """Error of a load that is 15 % heavier than planned, in a gust: worst, at 6 s, at 8 s [m]."""
    run = sv.close(sv.plant(CRANE, m_load=115.0), law, plan.state(0.0), (0.0, 8.0), disturbance=GUST)
    assert sv.verify(run).passed
    error = load_error(run)
    return error.max(), error[np.searchsorted(run.t, 6.0 - 1e-9)], error[-1]


# the crane of the design: theory.md, section 6 ------------------------------------------------------------------------


def test_feedforward_alone_loses_the_heavier_load(plan):
    assert heavier(plan, sv.feedforward(plan, sv.plant(CRANE)))[1] == pytest.approx(22.4, rel=0.01)


@pytest.mark.parametrize("varying", [True, False])
def test_lqr_keeps_the_heavier_load_near_its_path(plan, varying):
    _, at_6, _ = heavier(plan, sv.lqr(plan, sv.plant(CRANE), varying=varying, **WEIGHTS))
    assert 0.140 <= at_6 <= 0.160


@pytest.mark.parametrize("varying", [True, False])
def test_the_integral_of_the_program_takes_it_back(plan, varying):
    law = sv.lqr(plan, sv.plant(CRANE), integral=1e4, varying=varying, **WEIGHTS)
    worst, at_6, at_8 = heavier(plan, law)
    assert worst <= 0.060 and at_6 <= 0.010 and at_8 <= 0.003
    assert law.state_names == ("integral of X_residual", "integral of Z_residual")  # X and Z are outputs


HELD = {"x": 1e4, "Z_residual": 1e4}


def test_the_trolley_is_held_under_steady_wind_that_moves_the_load(plan):
    plant, wind = sv.plant(CRANE), -80.0
    law = sv.lqr(plan, plant, integral=HELD)
    assert law.state_names == ("integral of Z_residual", "integral of x")
    noisy = sv.output_feedback(law, plant, {"x": 1e-3, "l": 1e-3, "theta": 1e-3}, process=dict.fromkeys("xl", 1e-2))
    bounded = sv.limited(law, sv.plant(CRANE, limits={"trolley": 400.0, "hoist": (-3000.0, 0.0)}))
    leaning = np.arcsin(wind / (100.0 * 9.81 * 2.0))
    for held, within in ((law, 1e-4), (bounded, 1e-4), (noisy, 1e-3)):
        run = sv.close(plant, held, plan.state(0.0), (0.0, 20.0), disturbance={"theta": wind})
        assert abs(run.error["x"][-1]) < within and abs(run.residual["Z"][0, -1]) < within
        assert run["theta"][-1] == pytest.approx(leaning, rel=2e-2)
        assert abs(run.residual["X"][0, -1] - 2.0 * np.sin(leaning)) < 3e-3
    both = sv.close(plant, law, plan.state(0.0), (0.0, 3.0), disturbance={"theta": wind})
    many = sv.close_many(both, {"m_load": [100.0, 115.0]})
    assert many["final x"][0] == pytest.approx(both["x"][-1], abs=1e-12)


def test_the_integral_of_an_output_is_that_of_the_residual_about_the_same_path():
    p, q = sv.parameters(m=2.0, arm=0.5), sv.coordinates("x phi")
    x, phi = q
    load = x + p.arm * ca.sin(phi)
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.m, x) + sv.particle(q, 1.0, phi), actuators={"force": x, "torque": phi},
        parameters=p, outputs={"load": load, "speed": q.dt(load), "pull": q.d(2)[0]},
    )  # fmt: skip
    path = sv.paths.rest_to_rest(start=(0.0, 0.0), end=(1.0, 0.8), duration=2.0, smoothness=4)
    r = q.references(place=path[0], turn=path[1])
    model = sv.derive(mechanism, sv.Program({"place": load - r.place, "turn": phi - r.turn}, by="actuators"))
    plan, plant = sv.simulate(model, model.start(0.0), (0.0, 2.0)), sv.plant(mechanism, arm=0.6)
    laws = [sv.lqr(plan, plant, integral={name: 1e4}) for name in ("place", "load")]
    assert np.array_equal(*(law.info["gains"] for law in laws))
    runs = [sv.close(plant, law, plan.state(0.0), (0.0, 4.0), disturbance={"x": 3.0}) for law in laws]
    assert np.abs(runs[0].states - runs[1].states).max() < 1e-8 < 1e-3 < np.abs(runs[0].error["x"]).max()
    law = sv.lqr(plan, plant, integral={"speed": 10.0, "dphi": 10.0})
    assert law.state_names == ("integral of dphi", "integral of speed")
    with refused(sv.errors.SpecificationError, "order 2", "'load'", name="pull"):
        sv.lqr(plan, plant, integral={"pull": 1.0})
    with refused(sv.errors.NameUnknown, match="load"):
        sv.lqr(plan, plant, integral={"lode": 1.0})


def test_defaults_are_the_weights_of_the_design(plan):
    plain = sv.lqr(plan, sv.plant(CRANE), integral=True)
    said = sv.lqr(plan, sv.plant(CRANE), integral={"X_residual": 1e4, "Z_residual": 1e4}, **WEIGHTS)
    named = sv.lqr(plan, sv.plant(CRANE), Q={"theta": 1e3}, R={"hoist": 1e-3}, integral=[1e4, 1e4])
    assert np.array_equal(plain.schedule, said.schedule) and np.array_equal(plain.schedule, named.schedule)


def test_a_plant_as_planned_follows_its_plan(plan):
    run = sv.close(sv.plant(CRANE), sv.lqr(plan, sv.plant(CRANE)), plan.state(0.0), (0.0, 8.0))
    assert load_error(run).max() < 1e-4
    assert np.abs(run.error["theta"]).max() < 1e-4


def test_redundant_coordinates_give_a_law_as_well(plan):
    mechanism, program = gallery["overhead-crane-redundant"].build()
    model = sv.derive(mechanism, program)
    redundant = sv.simulate(model, model.start(guess=gallery["overhead-crane-redundant"].guess), (0.0, 8.0))
    for varying in (True, False):
        law = sv.lqr(redundant, sv.plant(mechanism), integral=True, varying=varying)
        run = sv.close(sv.plant(mechanism, m_load=115.0), law, redundant.state(0.0), (0.0, 8.0))
        assert load_error(run).max() < 0.060 and load_error(run)[-1] < 1e-3
        assert np.abs(run.residual["rope"]).max() < 1e-12 and sv.verify(run).passed


# gains ----------------------------------------------------------------------------------------------------------------


def test_the_discretisation_of_a_double_integrator_is_exact():
    A, B = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[[0.0], [0.5]]])
    Ad, Bd = discretised(A, B, 0.2)
    assert Ad[0] == pytest.approx(np.array([[1.0, 0.2], [0.0, 1.0]]))
    assert Bd[0, :, 0] == pytest.approx([0.5 * 0.2**2 / 2, 0.5 * 0.2])


def test_exponentials_are_those_of_scipy():
    from scipy.linalg import expm

    matrices = np.random.default_rng(1).uniform(-1, 1, (5, 6, 6)) * np.array([1e-3, 0.1, 1.0, 5.0, 20.0])[:, None, None]
    for found, wanted in zip(exponentials(matrices), expm(matrices), strict=True):
        assert found == pytest.approx(wanted, rel=1e-11, abs=1e-12 * np.abs(wanted).max())


def held_spring(stiffness, damping, mass, period):
    """[A B; 0 0] Ts of a mass on a spring, driven by a held force."""
    return period * np.array([[0.0, 1.0, 0.0], [-stiffness / mass, -damping / mass, 1 / mass], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    "stiffness, damping, mass, period",
    [
        (1e9, 0.0, 1.0, 1e-2),
        (1e9, 1e2, 1.0, 1e-2),
        (1e10, 0.0, 1.0, 1e-2),
        (1e6, 0.0, 1e-3, 1e-2),
        (1e3, 1e8, 1.0, 1e-2),
        (2e8, 2e8, 1.0, 1e-1),
        (-1e4, 0.0, 1.0, 1e-2),
        (1e7, 0.0, 1e9, 1.0),
        (1e4, 1e-2, 1e-9, 1e-5),
    ],
)
def test_exponentials_of_stiff_springs_are_exact_in_every_entry(stiffness, damping, mass, period):
    """Against 80 digits; norms up to 1e8, of which most is the difference between m and m/s."""
    mpmath = pytest.importorskip("mpmath")
    matrix = held_spring(stiffness, damping, mass, period)
    with mpmath.workdps(80):
        wanted = np.array(mpmath.expm(mpmath.matrix(matrix.tolist()), method="taylor").tolist()).astype(float)
    units = np.array([1.0, max(1.0, np.sqrt(abs(stiffness) / mass)), 1.0])
    rounding = 1e-16 * units[:, None] / units  # of entries that decay to nothing beside those of order one
    for found in exponentials(np.stack([matrix, np.zeros((3, 3)), matrix]))[::2]:
        assert (np.abs(found - wanted) <= 1e-12 * np.abs(wanted) + rounding).all()


def at_sample(plan, plant, k, rate=100.0):
    reference = Reference(plan, plant, rate)
    A, B = discretised(*reference.linearised(), 1 / rate)
    return A[k], B[k]


def test_frozen_gains_are_those_of_python_control(plan):
    import control

    plant = sv.plant(CRANE)
    law = sv.lqr(plan, plant, varying=False, **WEIGHTS)
    for k in (0, 250, 700):
        K, _, poles = control.dlqr(*at_sample(plan, plant, k), np.diag(WEIGHTS["Q"]), 1e-3 * np.eye(2))
        assert law.info["gains"][k] == pytest.approx(K, rel=1e-6, abs=1e-6 * np.abs(K).max())
        assert np.abs(poles).max() < 1


def test_varying_gains_minimise_the_cost_along_the_plan(plan):
    """The Riccati gains against the least cost of all inputs over a short horizon, by least squares."""
    from scipy.linalg import solve_discrete_are

    plant, Q, R, first = sv.plant(CRANE), np.diag(WEIGHTS["Q"]), 1e-3 * np.eye(2), 780
    law = sv.lqr(plan, plant, **WEIGHTS)
    A, B = discretised(*Reference(plan, plant, 100.0).linearised(), 0.01)
    P = solve_discrete_are(A[-1], B[-1], Q, R)
    x0 = np.array([0.1, -0.05, 0.02, 0.3, -0.1, 0.2])
    count = len(A) - first
    free, forced = [np.eye(6)], [np.zeros((6, 2 * count))]
    for k in range(count):
        step = np.zeros((6, 2 * count))
        step[:, 2 * k : 2 * k + 2] = B[first + k]
        free.append(A[first + k] @ free[-1])
        forced.append(A[first + k] @ forced[-1] + step)
    roots = [np.linalg.cholesky(Q).T] * count + [np.linalg.cholesky(P).T]
    left = np.vstack([*(w @ f for w, f in zip(roots, forced, strict=True)), np.sqrt(1e-3) * np.eye(2 * count)])
    right = np.concatenate([*(w @ f @ x0 for w, f in zip(roots, free, strict=True)), np.zeros(2 * count)])
    best = np.linalg.lstsq(left, -right, rcond=None)[0]
    assert -law.info["gains"][first] @ x0 == pytest.approx(best[:2], rel=1e-7)


def test_both_kinds_agree_where_the_plan_rests(plan):
    varying, frozen = (sv.lqr(plan, sv.plant(CRANE), integral=True, varying=v).info["gains"] for v in (True, False))
    assert varying[-1] == pytest.approx(frozen[-1], rel=1e-7, abs=1e-6)
    assert varying[-100] == pytest.approx(frozen[-100], rel=1e-6, abs=1e-5)
    assert np.abs(varying[300] - frozen[300]).max() > 1e-3 * np.abs(frozen[300]).max()


def test_a_lag_is_part_of_the_design(plan):
    slow = sv.plant(CRANE, lag={"trolley": 0.2})
    knowing = sv.close(slow, sv.lqr(plan, slow), plan.state(0.0), (0.0, 8.0))
    assert "trolley" in knowing.law.measures
    assert load_error(knowing).max() < 5e-3
    assert knowing.law.info["largest spectral radius along the plan"] < 1.0


def test_the_law_says_what_it_is(plan):
    law = sv.lqr(plan, sv.plant(CRANE), integral={"Z": 1e4})
    assert law.state_names == ("integral of Z",) and len(law.state) == 1
    for fact in ("time-varying", "100 Hz", "spectral radius", "trolley, hoist"):
        assert fact in repr(law)
    assert law.info["largest spectral radius along the plan"] < 1.0


# weights and refusals -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "wanted"),
    [(None, [1.0, 2.0]), (3.0, [3.0, 3.0]), ({"b": 5}, [1.0, 5.0]), ([4.0, 6.0], [4.0, 6.0])],
)
def test_weights_are_numbers_names_or_arrays(given, wanted):
    assert weights(given, [1.0, 2.0], ("a", "b"), "state", "Q") == pytest.approx(np.diag(wanted))
    full = np.array([[2.0, 1.0], [1.0, 2.0]])
    assert weights(full, [1.0, 2.0], ("a", "b"), "state", "Q") == pytest.approx(full)


def two_masses(stiffness):
    """Two masses of which only one is driven: the other, on a spring, is out of reach."""
    p = sv.parameters(m=1.0)
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, x) + sv.particle(q, p.m, y),
        potential=stiffness * y**2 / 2,
        actuators={"force": x},
        parameters=p,
    )
    program = sv.Program({"X": x - q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=3)).X})
    model = sv.derive(mechanism, program, keep=["y"])
    return sv.simulate(model, model.start(y=0.0, dy=0.0), (0.0, 1.0)), sv.plant(mechanism)


def test_what_is_out_of_reach_and_does_not_grow_is_left_alone():
    plan, plant = two_masses(4.0)
    law = sv.lqr(plan, plant)
    assert np.abs(law.info["gains"][:, :, [1, 3]]).max() < 1e-9
    assert law.info["spectral radius at its end"] == pytest.approx(1.0, abs=1e-9)
    run = sv.close(plant, law, plan.state(0.0) + [0.1, 0.0, 0.0, 0.0], (0.0, 1.0))
    assert abs(run.error["x"][-1]) < 0.02
    with refused(sv.errors.ServoError, "Riccati"):
        sv.lqr(plan, plant, varying=False)


BAD = {
    "Q of five": (lambda p, m: sv.lqr(p, m, Q=[1.0] * 5), sv.errors.SpecificationError, {"shape": (5,)}),
    "Q of text": (lambda p, m: sv.lqr(p, m, Q="large"), sv.errors.SpecificationError, "Q"),
    "Q of no state": (lambda p, m: sv.lqr(p, m, Q={"thet": 1.0}), sv.errors.NameUnknown, {"match": "theta"}),
    "negative Q": (lambda p, m: sv.lqr(p, m, Q={"x": -1.0}), sv.errors.SpecificationError, "semidefinite"),
    "odd Q": (lambda p, m: sv.lqr(p, m, Q=np.triu(np.ones((6, 6)))), sv.errors.SpecificationError, "symmetric"),
    "R of zero": (lambda p, m: sv.lqr(p, m, R=0.0), sv.errors.SpecificationError, "definite"),
    "R of three": (lambda p, m: sv.lqr(p, m, R=np.eye(3)), sv.errors.SpecificationError, {"shape": (3, 3)}),
    "R of NaN": (lambda p, m: sv.lqr(p, m, R=np.nan), sv.errors.SpecificationError, "definite"),
    "integral of nothing": (lambda p, m: sv.lqr(p, m, integral={"Y": 1.0}), sv.errors.NameUnknown, {"name": "Y"}),
    "integral of three": (lambda p, m: sv.lqr(p, m, integral=[1.0] * 3), sv.errors.SpecificationError, {"shape": (3,)}),
    "rate of zero": (lambda p, m: sv.lqr(p, m, rate=0.0), sv.errors.SpecificationError, "rate"),
    "plant of a delay": (lambda p, m: sv.lqr(p, sv.plant(CRANE, delay=0.02)), sv.errors.SpecificationError, "0.02 s"),
    "varying of text": (lambda p, m: sv.lqr(p, m, varying="frozen"), sv.errors.SpecificationError, "varying='frozen'"),
    "no plan": (lambda p, m: sv.lqr(m, m), sv.errors.SpecificationError, "Plant"),
    "out of reach": (lambda p, m: sv.lqr(*two_masses(-4.0)), sv.errors.ServoError, "Riccati"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_refused_by_name(plan, what):
    call, kind, fact = BAD[what]
    with refused(kind, fact):
        call(plan, sv.plant(CRANE))


def test_a_residual_of_accelerations_is_not_fed_back():
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x), actuators={"force": x})
    model = sv.derive(mechanism, sv.Program({"A": q.d(2)[0] - 1.0}))
    plan = sv.simulate(model, model.start(x=0.0, dx=0.0), (0.0, 1.0))
    with refused(sv.errors.SpecificationError, "order 0 or 1"):
        sv.lqr(plan, sv.plant(mechanism), integral=True)
    with refused(sv.errors.SpecificationError, "order 2", name="A"):
        sv.lqr(plan, sv.plant(mechanism), integral={"A": 1.0})


# modes out of reach --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trailer():
    """A robot whose wheels' angles are coordinates, with a trailer: 0.1 (φ_r - φ_l) - 0.6 ψ stays as it was."""
    q = sv.coordinates("x y psi theta phi_l phi_r")
    (x, y, psi, theta, _, _), (dx, dy, dpsi, dtheta, dl, dr) = q, q.d(1)
    behind = ca.vertcat(x - ca.cos(theta), y - ca.sin(theta))
    vx, vy = q.dt(behind).elements()
    forward = dx * ca.cos(psi) + dy * ca.sin(psi)
    rolling = {
        "slip": -dx * ca.sin(psi) + dy * ca.cos(psi), "left": forward - 0.3 * dpsi - 0.1 * dl,
        "right": forward + 0.3 * dpsi - 0.1 * dr, "trailer": -vx * ca.sin(theta) + vy * ca.cos(theta),
    }  # fmt: skip
    gibbs = sv.rigid_body(q, 20.0, (0, 0, 2.0), position=(x, y), rates=(0, 0, dpsi))
    gibbs += sv.rigid_body(q, 10.0, (0, 0, 1.0), position=(behind[0], behind[1]), rates=(0, 0, dtheta))
    gibbs += 0.005 * (q.d(2)[4] ** 2 + q.d(2)[5] ** 2)
    mechanism = sv.Mechanism(
        q, gibbs=gibbs, constraints=rolling, actuators={"left motor": q.d(0)[4], "right motor": q.d(0)[5]}
    )
    model = sv.derive(mechanism, sv.Program({"X": behind[0] - q.t, "Y": behind[1] - 0.3 * ca.sin(q.t)}))
    start = model.start(guess={"x": 1.0, "dx": 1.0, "psi": 0.3, "theta": 0.3})
    return sv.simulate(model, start, (0.0, 6.0)), sv.plant(mechanism)


OUT_OF_REACH = {
    "one integral": {"integral": {"X": 1e6}},
    "a stiffer one": {"integral": {"X": 1e8}},
    "frozen time": {"varying": False},
    "frozen time with integrals": {"varying": False, "integral": True},
}


@pytest.mark.parametrize("how", OUT_OF_REACH)
def test_the_mode_that_no_input_reaches_is_named_with_what_may_stay_unweighted(how, trailer):
    names = {"mode": ["psi", "phi_l", "phi_r"], "unweighted": ["phi_l", "phi_r"]}
    with refused(sv.errors.ServoError, "psi, phi_l, phi_r", "left motor", "'phi_l': 0", **names):
        sv.lqr(*trailer, **OUT_OF_REACH[how])
    advised = OUT_OF_REACH[how] | {"Q": {"phi_l": 0.0, "phi_r": 0.0}, "varying": True}
    law = sv.lqr(*trailer, **advised)
    loop = sv.close(trailer[1], law, trailer[0].state(0.0), (0.0, 6.0))
    assert max(np.abs(loop.residual[name][0]).max() for name in "XY") < 1e-5


def test_a_growing_mode_out_of_reach_is_named():
    with refused(sv.errors.ServoError, "force", unweighted=[]) as caught:
        sv.lqr(*two_masses(-0.5))
    assert set(caught.value.details["mode"]) == {"y", "dy"}


def test_a_mode_that_no_weight_sees_is_named(plan):
    """An unweighted crane: nothing asks for its place or its swing."""
    with refused(sv.errors.ServoError, "weight") as caught:
        sv.lqr(plan, sv.plant(CRANE), Q=0.0, varying=False)
    assert "x" in caught.value.details["mode"]


def test_last_bits_of_a_neutral_mode_do_not_change_the_gains(monkeypatch):
    """The place along a straight line and the integral of the speed make a mode that no input reaches at the end."""
    scene = gallery["wheeled-robot"]
    mechanism, program = scene.build()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)

    def gains(seed=None):
        def perturbed(*given):
            A, B = discretised(*given)
            return A * (1 + 1e-16 * np.random.default_rng(seed).choice([-2, 0, 2], A.shape)), B

        monkeypatch.setattr(lqr_module, "discretised", discretised if seed is None else perturbed)
        return sv.lqr(plan, sv.plant(mechanism), R=1.0, integral={"speed": 1e4}).schedule

    exact = gains()
    for seed in range(6):
        assert np.abs(gains(seed) - exact).max() < 1e-6 * np.abs(exact).max()
