"""Output redefinition: ranges of stable internal dynamics against closed forms and the zeros of the linearised plant."""

import casadi as ca
import numpy as np
import pytest
from closed_forms import passive_arm_critical
from refusals import refused
from scipy.linalg import eig

import servoctl as sv
from servoctl.gallery import overhead_crane, passive_arm

OTHER = {"m": 6.875, "I": 0.57, "c": 50.0, "d": 0.25}


@pytest.fixture(scope="module")
def arm():
    return sv.derive(*passive_arm())


@pytest.fixture(scope="module")
def aircraft():
    """The aircraft of which a point at a height above the centre of mass is followed."""
    p = sv.parameters(M=50.0, J=25.0, l=1.0, h=0.1, tilt=np.radians(5.0), g=9.81, height=0.0)
    q = sv.coordinates("x z theta")
    x, z, theta = q
    across, along = (ca.vertcat(ca.cos(theta), ca.sin(theta)), ca.vertcat(-ca.sin(theta), ca.cos(theta)))
    lever = p.l * ca.cos(p.tilt) + p.h * ca.sin(p.tilt)
    path = sv.paths.rest_to_rest(start=(0.0, 0.0), end=(5.0, 2.0), duration=4.0, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    point = ca.vertcat(x, z) + p.height * along
    mechanism = sv.Mechanism(
        q, gibbs=sv.rigid_body(q, p.M, (0, 0, p.J), position=(x, z), rates=(0, 0, q.d(1)[2])),
        potential=p.M * p.g * z, parameters=p,
        actuators={"u1": ca.vertcat(along + ca.sin(p.tilt) * across, lever),
                   "u2": ca.vertcat(along - ca.sin(p.tilt) * across, -lever)},
    )  # fmt: skip
    return sv.derive(mechanism, sv.Program({"X": point[0] - r.X, "Z": point[1] - r.Z}))


def oscillator(coupling=None, **numbers):
    """A driven mass 2 and a spring-borne mass 1 whose own dynamics the program x = 0 leaves: y'' + d y' + k y = 0."""
    p = sv.parameters(**{"k": 4.0, "d": 0.3, "w": 0.0} | numbers)
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    S = sv.particle(q, 2.0, x) + sv.particle(q, 1.0, y)
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=p.k * (y - x) ** 2 / 2, forces=(0, -p.d * dy), actuators={"a": x}, parameters=p
    )
    path = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0, smoothness=4)).X
    return mechanism, sv.Program({"X": x + (coupling(p) if coupling else p.w) * y - path})


def zeros_of_the_plant(model, value, parameter, at):
    """Finite generalised eigenvalues of [A - s, B; C, D] by QZ, for residuals of order 0 and plain coordinates."""
    m = model.reduction.mechanism
    q, n = m.q, m.q.n
    p = np.where(np.array(list(model.numbers)) == parameter, value, model.parameters)
    symbols = ca.vertcat(*m.parameters.symbols)
    K, D = (ca.jacobian(m.balance, q.jet(k)) for k in (0, 1))
    C = ca.jacobian(ca.vertcat(*model.reduction.program.residuals.values()), q.jet(0))
    Eu = ca.SX.sym("u", m.E.shape[1])
    K = K - ca.jacobian(m.E @ Eu, q.jet(0))
    rest = ca.substitute(m.balance, ca.vertcat(*q.gamma(1), *q.gamma(2)), ca.SX.zeros(2 * n))
    balance = ca.Function("r", [q.t, q.jet(0), symbols], [rest, m.E])
    static, E = (np.array(a) for a in balance(at.t, at.values[:n], p))
    u = np.linalg.lstsq(E, static.ravel(), rcond=None)[0]
    still = (ca.vertcat(*q.gamma(1), *q.gamma(2)), ca.SX.zeros(2 * n))
    f = ca.Function("f", [q.t, q.jet(0), Eu, symbols], [ca.substitute(e, *still) for e in (m.mass, D, K, m.E, C)])
    M, D, K, E, C = (np.array(a) for a in f(at.t, at.values[:n], u, p))
    k = len(C)
    A = np.block([[np.zeros((n, n)), np.eye(n), np.zeros((n, k))], [-K, -D, E], [C, np.zeros((k, n + k))]])
    B = np.block([[np.eye(n), np.zeros((n, n + k))], [np.zeros((n, n)), M, np.zeros((n, k))], [np.zeros((k, 2 * n + k))]])
    alpha, beta = eig(A, B, right=False, homogeneous_eigvals=True)
    finite = np.abs(beta) > 1e-7 * np.abs(alpha)
    roots = alpha[finite] / beta[finite]
    return roots[np.lexsort((-roots.imag, -roots.real.round(6)))]


# known systems --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("numbers", "critical"), [({}, 0.4), (OTHER, 0.3996943899), ({"I": 0.02, "l": 2.0}, None)])
def test_the_passive_arm_is_minimum_phase_below_its_critical_weight(numbers, critical, arm):
    result = sv.minimum_phase(arm.with_parameters(**numbers), "Gamma", (0, 1), at=arm.start())
    (low, high), *more = result.stable
    assert low == 0.0 and not more
    if critical is None:
        passive = numbers["I"] + numbers["l"] ** 2 / 4
        critical = passive / (passive + numbers["l"] ** 2 / 2)
    assert high == pytest.approx(critical, abs=6e-11)
    assert result.ranges[1].verdict == "unstable" and result.ranges[1].unstable == 1
    (value,) = result.critical
    assert value.value == high and (value.states, value.free, value.flat) == (1, 2, False)


def test_the_critical_weight_is_exact(arm):
    result = sv.minimum_phase(arm, "Gamma", (0, 1))
    assert result.stable[0][1] == pytest.approx(passive_arm_critical(), abs=1e-14)


@pytest.mark.parametrize(("numbers", "angle"), [({}, 48.1896851), (OTHER, 48.254875)])
def test_where_the_relative_degree_is_lost(numbers, angle, arm):
    result = sv.minimum_phase(arm.with_parameters(**numbers), "Gamma", (0, 1))
    first, second = result.lost(0.5)
    for state in (first, second):
        assert abs(np.degrees(state["q2"])) == pytest.approx(angle, abs=5e-7)
        assert state["q1"] + 0.5 * state["q2"] == pytest.approx(0.0, abs=1e-12)
    assert first["q2"] == pytest.approx(-second["q2"])
    assert result.lost(0.1) == []  # 1/3 - 0.1 (1/3 + cos(q2)/2) has no zero


def test_the_eigenvalues_of_the_other_arm(arm):
    result = sv.minimum_phase(arm.with_parameters(**OTHER), "Gamma", (0, 1))
    assert result.eigenvalues(0.5) == pytest.approx([9.550286, -9.115030], abs=5e-7)


def test_the_aircraft_is_flat_at_one_point_and_unstable_below(aircraft):
    result = sv.minimum_phase(aircraft, "height", (-0.1, 0.2))
    assert result.flat == pytest.approx([0.0433649377], abs=5e-11)
    assert result.eigenvalues(0.0) == pytest.approx([15.0405993, -15.0405993], abs=5e-8)
    assert [r.verdict for r in result.ranges] == ["unstable", "marginal"] and result.stable == ()
    assert result.eigenvalues(result.flat[0]).size == 0


def test_without_damping_the_passive_arm_is_marginal(arm):
    result = sv.minimum_phase(arm.with_parameters(d=0.0), "Gamma", (0, 1))
    assert [r.verdict for r in result.ranges] == ["marginal", "unstable"] and result.stable == ()
    assert result.ranges[0].high == pytest.approx(0.4, abs=1e-14) and result.critical[0].states == 0


# ways in which roots leave the left half plane ------------------------------------------------------------------------


def test_a_root_through_zero():
    """y'' + 0.3 y' + k y: a real root passes at k = 0; pairs become real at 0.0225, which changes nothing."""
    result = sv.minimum_phase(sv.derive(*oscillator()), "k", (-2.0, 3.7))
    assert [r.verdict for r in result.ranges] == ["unstable", "stable"]
    assert result.stable[0] == pytest.approx((0.0, 3.7), abs=1e-9) and result.critical == ()
    assert result.eigenvalues(2.0) == pytest.approx(np.roots([1.0, 0.3, 2.0]), abs=1e-12)


def test_a_pair_through_the_axis():
    """y'' + d y' + 4 y: a pair passes at ±2i, d = 0."""
    result = sv.minimum_phase(sv.derive(*oscillator()), "d", (-1.0, 3.0))
    assert [(r.verdict, r.unstable) for r in result.ranges] == [("unstable", 2), ("stable", 0)]
    assert result.stable[0][0] == pytest.approx(0.0, abs=1e-9)


def test_a_root_that_touches_the_axis_divides_a_range():
    """φ = x - c y with c = 1/(1 + (w - 0.3)²): y'' + 0.3 y' + 4 (1 - c) y = 0 is marginal at w = 0.3 alone."""
    result = sv.minimum_phase(sv.derive(*oscillator(lambda p: -1.0 / (1.0 + (p.w - 0.3) ** 2))), "w", (0.0, 1.0))
    assert [r.verdict for r in result.ranges] == ["stable", "stable"]
    assert result.ranges[0].high == pytest.approx(0.3, abs=1e-6)
    assert result.eigenvalues(0.3) == pytest.approx([0.0, -0.3], abs=1e-9)


@pytest.fixture(scope="module")
def narrow():
    """φ = x - c y with 4 (1 - c) = (w - w0)² - h²: unstable between w0 - h and w0 + h alone."""
    specification = oscillator(lambda p: ((p.w - p.middle) ** 2 - p.half**2) / 4 - 1.0, middle=0.3, half=0.1)
    return sv.derive(*specification)


@pytest.mark.parametrize(("middle", "half"), [(0.3, 1e-2), (0.5123, 1e-5)])
def test_a_narrow_unstable_range_is_found(middle, half, narrow):
    result = sv.minimum_phase(narrow.with_parameters(middle=middle, half=half), "w", (0.0, 1.0))
    assert [r.verdict for r in result.ranges] == ["stable", "unstable", "stable"]
    assert [result.ranges[1].low, result.ranges[1].high] == pytest.approx([middle - half, middle + half], abs=half / 4)


@pytest.mark.parametrize("ends", [(0.0, 1.0), (-0.4, 1.1)])
def test_a_highest_coefficient_that_touches_zero_is_found(ends):
    """A damped plate on a car tilted by w - 0.3: sin²(w - 0.3) multiplies s''; there the relative degree is 3."""
    p = sv.parameters(w=0.0)
    q = sv.coordinates("x s")
    (x, s), (_, ds) = q, q.d(1)
    c = ca.cos(p.w - 0.3)
    plate = ca.vertcat(x + s * c, s * ca.sin(p.w - 0.3))
    S = sv.particle(q, 1.0, x) + sv.particle(q, 2.0, plate)
    mechanism = sv.Mechanism(q, gibbs=S, potential=5 * s**2 / 2, forces=(0, -ds), actuators={"F": x}, parameters=p)
    path = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=4)).X
    result = sv.minimum_phase(sv.derive(mechanism, sv.Program({"X": x + s * c - path})), "w", ends)
    (critical,) = result.critical
    assert critical.value == pytest.approx(0.3, abs=1e-7)  # a double root, known to the square root of rounding
    assert result.eigenvalues(0.3) == pytest.approx([-5.0], abs=1e-6)  # s' + 5 s = 0
    assert [r.verdict for r in result.ranges] == ["stable"]


def test_several_ranges():
    """k = sin(w): stable where the sine is positive."""
    p = sv.parameters(w=1.0)
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    S = sv.particle(q, 2.0, x) + sv.particle(q, 1.0, y)
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=ca.sin(p.w) * y**2 / 2, forces=(0, -0.5 * dy), actuators={"a": x}, parameters=p
    )
    program = sv.Program({"X": x - q.references(X=sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=4)).X})
    with refused(sv.errors.SpecificationError, "keep=['y']", parameter="w", left_out=("y",)):
        sv.minimum_phase(sv.derive(mechanism, program), "w", (1.0, 11.0))
    result = sv.minimum_phase(sv.derive(mechanism, program, keep=["y"]), "w", (1.0, 11.0))
    assert np.array(result.stable) == pytest.approx(np.array([(1.0, np.pi), (2 * np.pi, 3 * np.pi)]), abs=1e-8)
    assert len(repr(result).splitlines()) <= 12


# against the plant's zeros, and in other forms ------------------------------------------------------------------------


def test_eigenvalues_are_zeros_of_the_linearised_plant(arm, aircraft):
    for model, parameter, values in ((arm, "Gamma", (0.05, 0.3, 0.7)), (aircraft, "height", (-0.08, 0.01, 0.15))):
        result = sv.minimum_phase(model, parameter, (values[0], values[-1]))
        for value in values:
            assert result.eigenvalues(value) == pytest.approx(
                zeros_of_the_plant(model, value, parameter, model.start()), rel=1e-7, abs=1e-7
            )


def chain(n, parameter):
    """n masses on springs and dampers, the first driven; the output is a weighted mean of the first and the last."""
    p = sv.parameters(w=parameter)
    q = sv.coordinates(" ".join(f"x{i}" for i in range(n)))
    x, v = list(q), q.d(1)
    S = sum(sv.particle(q, 1.0 + 0.3 * i, x[i]) for i in range(n))
    U = sum((3.0 + i) * (x[i] - x[i + 1]) ** 2 / 2 for i in range(n - 1)) + 0.5 * x[-1] ** 2 / 2
    drag = ca.vertcat(*(-0.4 * rate for rate in v))
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, forces=drag, actuators={"force": x[0]}, parameters=p)
    path = q.references(X=sv.paths.rest_to_rest(0.0, 0.0 + 1.0, duration=1.0, smoothness=14)).X
    return sv.derive(mechanism, sv.Program({"X": (1 - p.w) * x[0] + p.w * x[-1] - path}))


def test_four_masses_against_the_zeros_of_the_plant():
    model = chain(4, 0.2)
    result = sv.minimum_phase(model, "w", (0.0, 1.0))
    for value in (0.0, 0.15, 0.4, 0.77, 0.95):
        roots = zeros_of_the_plant(model, value, "w", model.start())
        assert result.eigenvalues(value) == pytest.approx(roots, rel=1e-6, abs=1e-7)
        here = next(r for r in result.ranges if r.low <= value <= r.high)
        assert here.unstable == int((roots.real > 0).sum())
    edges = [edge for pair in result.stable for edge in pair if 0.0 < edge < 1.0]
    assert len(edges) == 1 and [(c.value, c.states) for c in result.critical] == [(1.0, 0)]
    for edge in edges:  # a pair lies on the axis
        assert abs(zeros_of_the_plant(model, edge, "w", model.start()).real).min() < 1e-7


def test_absolute_coordinates_and_quasi_velocities_give_the_same_boundary():
    """The passive arm by the absolute angle of its second link, by rates of it, and by points with material links."""
    p = sv.parameters(c=10.0, d=1.0, Gamma=0.3)

    def links(q, one, two, rates, constraints=None):
        first = ca.vertcat(ca.cos(one), ca.sin(one))
        second = ca.vertcat(ca.cos(two), ca.sin(two))
        S = sv.rigid_body(q, 1.0, (0, 0, 1 / 12), position=first / 2, rates=(0, 0, rates[0]))
        S += sv.rigid_body(q, 1.0, (0, 0, 1 / 12), position=first + second / 2, rates=(0, 0, rates[1]))
        bend, slide = two - one, rates[1] - rates[0]
        torque = -p.d * slide * ca.vertcat(-1, 1, *([0] * (q.n - 2)))
        path = q.references(angle=sv.paths.rest_to_rest(0.0, np.pi / 2, duration=2.0, smoothness=4)).angle
        mechanism = sv.Mechanism(
            q, gibbs=S, potential=p.c * bend**2 / 2, forces=q.V.T @ torque if not q.plain else torque,
            actuators={"torque": one}, constraints=constraints, parameters=p,
        )  # fmt: skip
        return sv.derive(mechanism, sv.Program({"angle": one + p.Gamma * bend - path}))

    plain = sv.coordinates("one two")
    quasi = sv.coordinates("one two").with_quasi_velocities("u v", ca.SX([[1, 0], [1, 2]]))
    bound = sv.coordinates("one two z")
    models = [
        links(plain, *plain, plain.d(1)),
        links(quasi, *quasi, quasi.d(1)),
    ]
    one, two, z = bound
    rates = bound.d(1)
    first, second = ca.vertcat(ca.cos(one), ca.sin(one)), ca.vertcat(ca.cos(two), ca.sin(two))
    S = sv.rigid_body(bound, 1.0, (0, 0, 1 / 12), position=first / 2, rates=(0, 0, rates[0]))
    S += sv.rigid_body(bound, 1.0, (0, 0, 1 / 12), position=first + second / 2, rates=(0, 0, rates[1]))
    torque = -p.d * rates[2] * ca.vertcat(0, 0, 1)
    path = bound.references(angle=sv.paths.rest_to_rest(0.0, np.pi / 2, duration=2.0, smoothness=4)).angle
    mechanism = sv.Mechanism(
        bound, gibbs=S, potential=p.c * z**2 / 2, forces=torque, actuators={"torque": one},
        constraints={"bend": two - one - z}, parameters=p,
    )  # fmt: skip
    models.append(sv.derive(mechanism, sv.Program({"angle": one + p.Gamma * z - path})))
    for model in models:
        result = sv.minimum_phase(model, "Gamma", (0, 1))
        assert result.stable[0][1] == pytest.approx(0.4, abs=1e-12), model
        assert result.eigenvalues(0.3) == pytest.approx([-6 + np.sqrt(84) * 1j, -6 - np.sqrt(84) * 1j], abs=1e-9)


@pytest.mark.parametrize("length", [1e-3, 1e3])
def test_units_do_not_matter(length):
    """The aircraft-like boundary of a mass on a car in millimetres and in kilometres: the critical value scales."""
    p = sv.parameters(a=0.0, L=length)
    q = sv.coordinates("x theta")
    (x, theta), (_, dtheta) = q, q.d(1)
    bob = ca.vertcat(x + p.L * ca.sin(theta), -p.L * ca.cos(theta))
    S = sv.particle(q, 3.0, x) + sv.particle(q, 2.0, bob)
    mechanism = sv.Mechanism(q, gibbs=S, potential=2 * 9.81 * length * bob[1], forces=(0, -0.1 * length**2 * dtheta),
                             actuators={"force": x}, parameters=p)  # fmt: skip
    path = q.references(X=sv.paths.rest_to_rest(0.0, length, duration=4.0, smoothness=4)).X
    model = sv.derive(mechanism, sv.Program({"X": x + p.a * ca.sin(theta) - path}))
    result = sv.minimum_phase(model, "a", (0.0, 1.7 * length))
    # a point at the distance a below the car: L - a multiplies θ'', so the bob itself loses the relative degree
    assert result.stable[0][1] / length == pytest.approx(1.0, abs=1e-10)


# printing, files ------------------------------------------------------------------------------------------------


def test_results_print_become_plain_and_are_drawn(arm, aircraft):
    for model, parameter, values in ((arm, "Gamma", (0, 1)), (aircraft, "height", (-0.1, 0.2))):
        result = sv.minimum_phase(model, parameter, values)
        assert 3 <= len(repr(result).splitlines()) <= 12 and parameter in repr(result)
        plain = result.as_dict()
        assert plain["parameter"] == parameter and len(plain["ranges"]) == len(result.ranges)
        figure = result.plot()
        assert figure.axes[0].get_xlabel() == parameter


# bad input ------------------------------------------------------------------------------------------------------------


def test_bad_input(arm):
    with refused(sv.errors.NameUnknown, name="gamma", match="Gamma"):
        sv.minimum_phase(arm, "gamma", (0, 1))
    for values in ((1, 0), 0.0, "all", (0, np.nan), (0, None), (0.5, 0.5)):
        with refused(sv.errors.SpecificationError, name="Gamma"):
            sv.minimum_phase(arm, "Gamma", values)
    with refused(sv.errors.SpecificationError, type="dict"):
        sv.minimum_phase(arm, "Gamma", (0, 1), at={"q1": 0.0})
    with refused(sv.errors.SpecificationError, type="str"):
        sv.minimum_phase("arm", "Gamma", (0, 1))
    result = sv.minimum_phase(arm, "Gamma", (0, 1))
    for value in ("0.5", None, np.nan):
        for call in (result.eigenvalues, result.lost):
            with refused(sv.errors.SpecificationError, "Gamma"):
                call(value)


def test_states_that_are_no_equilibria_are_refused(arm):
    with refused(sv.errors.InconsistentStart, "q2", t=0.0) as caught:
        sv.minimum_phase(arm, "Gamma", (0, 1), at=arm.start(q2=0.3))
    assert caught.value.details["equilibrium"]["q2"] == pytest.approx(0.0, abs=1e-12)
    with refused(sv.errors.InconsistentStart, t=0.0):
        sv.minimum_phase(arm, "Gamma", (0, 1), at=arm.start(dq2=0.1))
    with refused(sv.errors.InconsistentStart, "moves", t=1.0):
        sv.minimum_phase(arm, "Gamma", (0, 1), at=arm.start(1.0))
    at_end = sv.minimum_phase(arm, "Gamma", (0, 1), at=arm.start(2.0, q2=0.0))
    assert at_end.stable[0][1] == pytest.approx(0.4, abs=1e-12)


def test_programs_without_actuators_are_refused():
    mechanism, program = passive_arm()
    ideal = sv.derive(mechanism, sv.Program(program.residuals, by="ideal"))
    with refused(sv.errors.SpecificationError, by="ideal"):
        sv.minimum_phase(ideal, "Gamma", (0, 1))


def test_rests_that_form_no_curve_are_refused():
    model = chain(4, 0.2)
    result = sv.minimum_phase(model, "w", (0.0, 0.5))
    with refused(sv.errors.SpecificationError, free=3):
        result.lost(0.2)


def test_a_flat_scene_has_no_internal_states_for_any_value():
    model = sv.derive(*overhead_crane(), guess={"l": 4.0})
    result = sv.minimum_phase(model, "m_load", (50.0, 150.0), at=model.start(guess={"l": 4.0}))
    assert [r.states for r in result.ranges] == [0] and result.ranges[0].verdict == "stable"
    assert "no internal states" in repr(result)


def test_moved_states_within_1e_6_are_equilibria(arm):
    near = sv.minimum_phase(arm, "Gamma", (0.1, 0.2), at=arm.start(q2=5e-7))
    assert near.stable == ((0.1, 0.2),)
    with refused(sv.errors.InconsistentStart):
        sv.minimum_phase(arm, "Gamma", (0.1, 0.2), at=arm.start(q2=5e-6))


@pytest.mark.parametrize(("mass", "states"), [(1e-9, 2), (1e-13, 1)])
def test_a_coefficient_counts_above_1e_11(mass, states):
    """m y'' + d y' + k y with d² >> m k: beside d and k, of the size of one, the inertia is seen above 1e-11."""
    p = sv.parameters(w=0.1)
    q = sv.coordinates("x y")
    (x, y), (_, dy) = q, q.d(1)
    S = sv.particle(q, 1.0, x) + sv.particle(q, mass, y)
    mechanism = sv.Mechanism(q, gibbs=S, potential=y**2 / 2, forces=(0, -dy), actuators={"a": x}, parameters=p)
    path = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, 1.0, smoothness=4)).X
    model = sv.derive(mechanism, sv.Program({"X": x + p.w * ca.sin(y) ** 2 - path}))
    assert sv.minimum_phase(model, "w", (0.05, 0.15)).eigenvalues(0.1).size == states


def test_a_relative_degree_that_is_lost_at_the_rest_itself_is_found():
    p, q = sv.parameters(w=0.5), sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    masses, springs = sv.particle(q, 1.0, x) + sv.particle(q, 1.0, y), 2.0 * (x - y) ** 2 + 3.0 * x**2
    mechanism = sv.Mechanism(q, masses, potential=springs, forces=(-0.1 * dx, -0.1 * dy), actuators={"a": y}, parameters=p)
    path = q.references(X=sv.paths.rest_to_rest(0.0, 0.1, duration=1.0, smoothness=4)).X
    found = sv.minimum_phase(sv.derive(mechanism, sv.Program({"X": x + p.w * y + y**2 - path})), "w", (-1.0, 1.0))
    assert [lost["y"] for lost in found.lost(0.5)] == pytest.approx([-0.25])  # where ∂X/∂y = w + 2y vanishes
    assert all(abs(lost["y"]) < 1e-15 for lost in found.lost(0.0)) and found.lost(0.0)
