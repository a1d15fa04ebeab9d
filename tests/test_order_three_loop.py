"""Rows of order 3 and more in a closed loop, on machines 10 % heavier than planned: closed forms and sampled chains."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from test_export_law import InC, close_to

import servoctl as sv
from servoctl.control.companion import fastest_poles, sampled_radius
from servoctl.control.inverse_dynamics import _Extension
from servoctl.errors import NameUnknown, ServoError, SpecificationError, UnstableInternalDynamics
from servoctl.gallery import gallery, vtol
from servoctl.interop import nlsys, start
from servoctl.methods import Adaptive
from servoctl.shell.loop import facts
from servoctl.spec.integrals import integrals

FINE = Adaptive("DOP853", rtol=1e-12, atol=1e-13)  # plans whose own error is no part of a quotient over one sample
SLOW = [-5.0]


def particle():
    q = sv.coordinates("x y")
    p = sv.parameters(m=1.0)
    body = sv.Mechanism(q, sv.particle(q, p.m, ca.vertcat(*q)), actuators={"fx": q[0], "fy": q[1]}, parameters=p)
    return body, ca.vertcat(*q)


def planned(body, program, span, method=None, **held):
    model = sv.derive(body, program)
    return sv.simulate(model, model.start(**held), span, method=method)


def spiral(order, c, span=(0.0, 4.0), method=None):
    """κ^(order) = c at speed 1."""
    body, place = particle()
    (dx, dy), (ax, ay) = body.q.d(1), body.q.d(2)
    rows = {"kappa": body.q.dt((dx * ay - dy * ax) / (dx**2 + dy**2) ** 1.5, order) - c}
    rows |= sv.programs.constant_speed("speed", body.q, place, 1.0)
    return planned(body, sv.Program(rows), span, method, x=0.0, y=0.0, dx=1.0, dy=0.0)


def mass(poles, **stated):
    """x''' = 2, with its law at 1 kHz."""
    q = sv.coordinates("x")
    p = sv.parameters(m=1.0)
    body = sv.Mechanism(q, sv.particle(q, p.m, q[0]), actuators={"f": q[0]}, parameters=p)
    row = q.d(3)[0] if stated else q.dt(q[0], 3)
    plan = planned(body, sv.Program({"jerk": row - 2.0}, **stated and {"integrals": {"jerk": q[0]}}), (0.0, 4.0))
    return plan, sv.computed(plan, sv.plant(body), rate=1000.0, poles={"jerk": poles})


def jerk():
    """The magnitude of the jerk is 2 m/s^3, in gravity, by two forces."""
    q = sv.coordinates("x z")
    p = sv.parameters(m=1.0, g=9.81, J=2.0)
    place = ca.vertcat(*q)
    forces = {"fx": q[0], "fz": q[1]}
    body = sv.Mechanism(q, sv.particle(q, p.m, place), potential=p.m * p.g * q[1], actuators=forces, parameters=p)
    start = {"x": 0.0, "z": 0.0, "dx": 1.0, "dz": 0.0, "d2x": 0.5, "d2z": 0.0}
    return planned(body, sv.Program(sv.programs.jerk_norm("jerk", q, place, 2.0)), (0.0, 2.0), **start)


def machine(plan, share=1.1):
    mechanism, masses = plan.model.reduction.mechanism, ("m", "m_load", "J", "I")
    values = dict(zip(mechanism.parameters.names, plan.model.parameters, strict=True))
    return sv.plant(mechanism, **{name: share * value for name, value in values.items() if name in masses})


def closed(law, plant=None, span=None, off=0.0, **conditions):
    plan = law.plan
    plant = machine(plan) if plant is None else plant
    return sv.close(plant, law, plan.state(plan.t[0]) + off, span or plan.span, **conditions)


@pytest.fixture(scope="module")
def spirals():
    return spiral(1, 0.5)


@pytest.fixture(scope="module")
def curved(spirals):
    """The law with one pole -5 on the sum of the curvature's errors."""
    return sv.computed(spirals, sv.plant(spirals.model.reduction.mechanism), rate=1000.0, poles={"kappa": SLOW, "speed": SLOW})


# evaluated -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "F", "quotient", "row"), [(100, 1.4e-5, 2.2e-5, 4.1e-5), (1000, 1.4e-7, 2.2e-7, 4.1e-7)])
def test_a_perfect_loop_is_read_as_one(rate, F, quotient, row):
    """Just after samples F is c h/2 ahead, and its derivative under the held input is -c."""
    plan = spiral(1, 0.5, (0.0, 2.0), FINE)
    loop = closed(sv.feedforward(plan, sv.plant(plan.model.reduction.mechanism), rate=rate), machine(plan, 1.0))
    e, windowed = loop.residual["kappa"]
    assert np.abs(e).max() < F and np.abs(np.diff(e[:-1])).max() * rate < quotient and np.abs(windowed).max() < quotient
    body, bare = plan.model.reduction.mechanism, {"kappa": ca.SX(plan.model.reduction.program.residuals["kappa"])}
    unknown = planned(body, sv.Program(bare | {"speed": plan.model.reduction.program.residuals["speed"]}), (0.0, 0.1), x=0.0, y=0.0, dx=1.0, dy=0.0)
    apart = sv.close(loop.plant, loop.law, plan.state(0.0), plan.span, plan=unknown)
    assert apart.residual["kappa"].shape == (1, len(loop.t)) and np.abs(apart.residual["kappa"]).max() < row


def test_the_loop_of_a_plan_alone_and_under_lqr(spirals):
    """The plan's forces on a heavier machine; LQR holds place and row, with an offset of its own."""
    plant = sv.plant(spirals.model.reduction.mechanism)
    alone, held = (closed(make(spirals, plant, rate=1000.0)).residual["kappa"] for make in (sv.feedforward, sv.lqr))
    assert alone[0, -1] == pytest.approx(0.494, rel=0.01) and abs(held[0, -1]) < 1e-3
    loop = closed(sv.lqr(spirals, plant, rate=1000.0))
    assert "shown as F − F along the plan: kappa" in str(loop)
    run = loop.to_run()
    assert np.array_equal(run.residual["kappa"], held)
    worst = max((np.abs(values[0]).max(), name) for name, values in loop.residual.items())
    assert f"largest residual {worst[0]:.1e} ({worst[1]})" in str(run)


def test_figures_and_reports_say_what_is_shown(curved):
    figures = pytest.importorskip("servoctl.figures")
    loop = closed(curved, span=(0.0, 0.2))
    assert loop.by_F == ("kappa",) and facts(loop)["as F minus F along the plan"] == ["kappa"]
    labels = [ax.get_ylabel() for ax in figures.closed(loop)]
    assert labels[:2] == ["residuals, SI", "F − F along the plan, SI"]
    words = {text.get_text() for text in figures.residuals(loop.to_run()).get_legend().get_texts()}
    assert words >= {"residual, or F − F along the plan", "1st derivative, or k-th quotient of F"}


def test_a_loop_of_few_samples_has_no_quotient():
    """Two or three middles have no third difference: there is one level, not a second one of NaN."""
    law = mass([-8.0, -10.0, -13.0])[1]
    shapes = [closed(law, span=(0.0, end)).residual["jerk"].shape for end in (0.002, 0.003, 0.004)]
    assert shapes == [(1, 3), (1, 4), (2, 5)]


# followed --------------------------------------------------------------------------------------------------------


def test_the_error_of_a_row_obeys_its_poles(spirals, curved):
    """e -> -δ c/Π|λ| with as many poles as k, nothing with one more."""
    plant = sv.plant(spirals.model.reduction.mechanism)
    loop = closed(curved)
    assert loop.residual["kappa"][0, -1] == pytest.approx(-0.01, rel=0.01)
    assert np.hypot(loop.error["x"][-1], loop.error["y"][-1]) == pytest.approx(0.034, rel=0.02)
    assert curved.info["free"] == "x, y, dx: not fed back, free to drift"
    for span in (None, (0.0, 1.0)):  # whose energy changes by 3e-5 and 6e-7 J of 0.55 J
        assert sv.verify(closed(curved, span=span)).passed
    twice = sv.computed(spirals, plant, rate=1000.0, poles={"kappa": 2 * SLOW, "speed": SLOW})
    assert abs(closed(twice).residual["kappa"][0, -1]) < 1e-6
    second = spiral(2, 0.25)
    law = sv.computed(second, sv.plant(second.model.reduction.mechanism), rate=1000.0, poles={"kappa": 2 * SLOW, "speed": SLOW})
    assert closed(law).residual["kappa"][0, -1] == pytest.approx(-1e-3, rel=0.01)


@pytest.mark.parametrize("stated", [{}, {"stated": True}])
def test_a_jerk_under_a_constant_force(stated):
    plan, law = mass([-8.0, -10.0, -13.0], **stated)
    for force in (0.0, 1.0):
        loop = closed(law, disturbance={"x": force})
        assert loop.residual["jerk"][0, -1] == pytest.approx(-1.923e-4, rel=0.02)
        assert abs(loop.residual["jerk"][1, -1]) < 1e-6
    held = closed(sv.lqr(plan, sv.plant(plan.model.reduction.mechanism), rate=1000.0, integral={"jerk": 1e4}), disturbance={"x": 1.0})
    assert held.signal["integral of jerk"][-1] != 0 and abs(held.residual["jerk"][0, -1]) < 5e-3


def test_a_constant_jerk_by_lqr():
    """Its row, of the magnitude of the jerk, is no derivative of anything: LQR about the plan is the law."""
    plan = jerk()
    plant, loops = sv.plant(plan.model.reduction.mechanism), []
    with refused(SpecificationError, "sv.lqr", name="jerk", order=3):
        sv.computed(plan, plant)
    for law in (sv.feedforward(plan, plant, rate=1000.0), sv.lqr(plan, plant, rate=1000.0), sv.lqr(plan, plant, rate=1000.0, integral={"x": 1e4, "z": 1e4})):
        loops.append(closed(law))
    places = [np.hypot(loop.error["x"], loop.error["z"])[-1] for loop in loops]
    assert places[0] > 1.0 and places[1] < 2e-3 and places[2] < 0.1 * places[1]
    assert np.abs(loops[1].residual["jerk"][0, 1000:]).max() < 0.25  # 10 % of 2 m/s^3: the plan's forces alone leave 0.35


def test_an_ideal_plan_of_order_three_names_its_row():
    scene = gallery["spiral"]
    model = sv.derive(*scene.build())
    plan = sv.simulate(model, model.start(**scene.start), (0.0, 0.5))
    for law in (sv.computed, sv.lqr):
        with refused(sv.errors.NotRealisable, "sv.lqr", 'by="actuators"', "'curvature'", names=("curvature",)):
            law(plan, sv.plant(model.reduction.mechanism))


def test_the_curvature_of_a_wheeled_robot():
    """A row of order 2 and relative degree 0: its accelerations are measured, too."""
    scene = gallery["wheeled-robot"]
    model = sv.derive(*scene.build())
    plan = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)
    plant, worst = sv.plant(model.reduction.mechanism), []
    for law in (sv.feedforward(plan, plant, rate=1000.0), sv.computed(plan, plant, rate=1000.0, poles={"speed": SLOW, "clothoid": SLOW}),
                sv.lqr(plan, plant, rate=1000.0)):  # fmt: skip
        loop = closed(law)
        worst.append(np.abs(loop["curvature"] - plan.sampled(loop.t)["curvature"]).max())
    assert worst[:2] == [pytest.approx(0.0714, rel=0.01), pytest.approx(0.0117, rel=0.02)] and worst[2] < 1e-3


def test_the_clothoid_of_an_arm():
    scene = gallery["clothoid-arm"]
    model = sv.derive(*scene.build())
    plan = sv.simulate(model, model.start(**scene.start, guess=scene.guess), (0.0, 1.0))
    plant, ends = sv.plant(model.reduction.mechanism), []
    for law in (sv.feedforward(plan, plant, rate=1000.0), sv.computed(plan, plant, rate=1000.0, poles=0.05), sv.lqr(plan, plant, rate=1000.0)):
        ends.append(closed(law).residual["clothoid"][0, -1])
    assert ends[0] < -0.3 and ends[1] == pytest.approx(-0.027, rel=0.03) and abs(ends[2]) < 1e-3


def test_a_crane_under_a_program_of_jerk():
    """Hidden rows: F = X and Z have relative degree 4 by dynamic extension, whatever the order of their rows."""
    q = sv.coordinates("x l theta")
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    path = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(5.0, 2.0), duration=6.0, smoothness=4)
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81)
    S = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load)
    r = q.references(X=path[0], Z=path[1])
    body = sv.Mechanism(q, S, potential=-p.m_load * p.g * load[1], actuators={"trolley": x, "hoist": l}, parameters=p)
    model = sv.derive(body, sv.Program({"X": q.dt(load[0], 3) - r.d(3)[0], "Z": load[1] - r.Z}))
    plan = sv.simulate(model, model.start(x=0.0, theta=0.0, guess={"l": 4.0}), (0.0, 8.0))
    law = sv.computed(plan, sv.plant(body), rate=1000.0, poles={"X": [-4.0] * 4, "Z": [-4.0] * 4})
    assert law.info["orders"] == {"X": 4, "Z": 4} and len(law.state) == 2
    loop = closed(law)
    assert loop.residual["Z"][0, -1] == pytest.approx(0.3505, rel=0.01) and abs(loop.residual["X"][0, -1]) < 1e-3
    assert abs(closed(sv.lqr(plan, sv.plant(body), rate=1000.0, integral=True)).residual["Z"][0, -1]) < 1e-4


def test_noise_in_the_curvature(curved):
    noise = {"x": 1e-4, "y": 1e-4, "dx": 1e-3, "dy": 1e-3}
    loop = closed(curved, machine(curved.plan, 1.0), sensors=sv.Sensors(noise, seed=1))
    assert loop.residual["kappa"][0].std() == pytest.approx(5.5e-3, rel=0.1)


def test_an_angle_is_followed_through_whole_turns():
    """The error of F = atan2 jumps by no turn where the plan and the machine pass π one after the other."""
    body, _ = particle()
    dx, dy = body.q.d(1)
    rows = {"heading": body.q.dt(ca.atan2(dy, dx), 2) - 0.5, "speed": body.q.dt(ca.sqrt(dx**2 + dy**2), 2) - 0.1}
    start = {"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0, "d2x": 0.0, "d2y": 0.0}
    plan = planned(body, sv.Program(rows), (0.0, 4.0), **start)
    law = sv.computed(plan, sv.plant(body), rate=1000.0, poles={"heading": 2 * SLOW, "speed": 2 * SLOW})
    loop = closed(law)
    assert loop.residual["heading"][0, -1] == pytest.approx(-0.1 * 0.5 / 25, rel=0.02)
    assert np.abs(loop.residual["heading"]).max() < 0.05 and np.abs(loop.inputs).max() < 10.0
    off = np.array([0.0, 0.0, 0.0, 0.05])  # the machine turns ahead
    integral = sv.lqr(plan, sv.plant(body), rate=1000.0, integral={"heading": 1.0})
    loop = closed(integral, off=off)
    assert np.abs(loop.residual["heading"][0]).max() < 0.1
    assert np.abs(loop.signal["integral of heading"]).max() < 0.1
    west = planned(body, sv.Program(rows), (0.0, 0.1), **start | {"dx": -1.0})
    assert np.isfinite(closed(sv.lqr(west, sv.plant(body), rate=1000.0, integral={"heading": 1.0})).inputs).all()


# sampled ---------------------------------------------------------------------------------------------------------


def test_displaced_loops_decay_as_the_sampled_chain():
    """x''' = 2 on the planned machine: two exact integrators under the hold, and a sum that is not."""
    plan, law = mass([-8.0, -10.0, -13.0])
    loop = closed(law, machine(plan, 1.0), (0.0, 1.0), off=np.array([1e-3, 0.0]))
    (c0, c1, c2), h, chain = np.poly([-8.0, -10.0, -13.0])[:0:-1], 1e-3, [(0.0, 1e-3, 0.0)]
    for _ in range(1000):
        total, e, de = chain[-1]
        u = -c0 * total - c1 * e - c2 * de
        chain.append((total + h * e, e + h * de + h**2 / 2 * u, de + h * u))
    assert np.abs(loop.error["x"] - np.array(chain)[:, 1]).max() < 1e-5
    assert np.abs(loop.signal["integral of jerk"] - np.array(chain)[:, 0]).max() < 1e-7


@pytest.mark.parametrize(("delay", "bound"), [(0, 2.0), (1, 1.0), (2, 0.618)])
def test_a_loop_turns_unstable_at_the_bound(delay, bound, spirals):
    plant = sv.plant(spirals.model.reduction.mechanism)
    law = sv.computed(spirals, plant, rate=100.0, poles={"kappa": SLOW, "speed": SLOW}, delay=delay)
    row, grows = 1 + 1 + len(law.inputs), []  # after the mass, the period and what is added
    for share in (0.97, 1.03):
        schedule = law.schedule.copy()
        schedule[row] = share * bound * 100.0
        placed = sv.Law(**{**vars(law), "schedule": schedule, "state": law.state + 1e-6 * (np.arange(len(law.state)) == 3)})
        e = np.abs(closed(placed, machine(spirals, 1.0), (0.0, 2.0), timing=sv.Timing(delay=delay)).residual["kappa"][0])
        grows.append(e[100:150].max() > e[:50].max())
    assert grows == [False, True] and fastest_poles(1, 0, delay) == pytest.approx(bound, rel=1e-3)


def test_bounds_of_sums_and_integrators():
    table = {
        (0, 1): (2.0, 2.0, 2.0, 2.0), (1, 1): (1.0, 0.4563, 0.2968, 0.2201), (2, 1): (0.6180, 0.2679, 0.1714, 0.1261),
        (0, 2): (1.0, 2 / 3, 0.5, 0.4), (1, 2): (0.4262, 0.2736, 0.2018, 0.1600), (2, 2): (0.2578, 0.1639, 0.1203, 0.0951),
    }  # fmt: skip
    for (delay, r), bounds in table.items():
        assert [fastest_poles(n, r, delay) for n in range(r, r + 4)] == pytest.approx(bounds, rel=2e-4, abs=5e-5)


def test_bounds_of_long_delays():
    """One integrator under feedback that is d samples late: p h = 2 sin(π/(4d + 2))."""
    for delay in (10, 25, 100, 1000):
        assert fastest_poles(1, 1, delay) == pytest.approx(2 * np.sin(np.pi / (4 * delay + 2)), rel=1e-3)


@pytest.mark.parametrize("n", [2, 4, 6, 8, 12])
def test_slow_poles_are_stable(n):
    """The slowest of n equal poles under the hold, 1 + p h s with s near -1; their spread is of the order of (p h)^(1/n)."""
    for step in (1e-1, 1e-3, 1e-5):
        assert -1.0 < (sampled_radius(np.full(n, -step), 1.0) - 1) / step < -0.5


def test_sums_stop_at_a_limit(spirals, curved):
    """With forces up to 1 N the spiral cannot go on; the sum does not grow meanwhile."""
    limits = {"fx": 1.0, "fy": 1.0}
    body = spirals.model.reduction.mechanism
    law = sv.computed(spirals, sv.plant(body, limits=limits), rate=1000.0, poles={"kappa": SLOW, "speed": SLOW})
    sums = [closed(one, sv.plant(body, m=1.1, limits=limits)).signal["integral of kappa"][-1] for one in (law, curved)]
    assert abs(sums[0]) < 0.03 < 0.5 < abs(sums[1])
    assert law.integrators == (3,) and law.state_names[3] == "integral of kappa"


def test_sums_stop_at_a_limit_of_the_rate(spirals, curved):
    """Forces that change by 0.3 N/s cannot follow either: the law knows them by what it commanded before."""
    body, limits = spirals.model.reduction.mechanism, {"fx": 0.3, "fy": 0.3}
    law = sv.computed(spirals, sv.plant(body, rate_limits=limits), rate=1000.0, poles={"kappa": SLOW, "speed": SLOW})
    plant = sv.plant(body, m=1.1, rate_limits=limits)
    loops = [closed(one, plant) for one in (law, curved)]
    assert [abs(loop.signal["integral of kappa"][-1]) for loop in loops] == [pytest.approx(0, abs=1e-3), pytest.approx(2.3, rel=0.05)]
    assert np.abs(loops[0].signal["fx before"][1:] - loops[0].inputs[0, :-1]).max() < 1e-12
    assert abs(loops[0].residual["kappa"][0, -1]) < abs(loops[1].residual["kappa"][0, -1])
    free = closed(sv.computed(spirals, sv.plant(body, rate_limits={"fx": 1e3}), rate=1000.0, poles={"kappa": SLOW, "speed": SLOW}))
    assert np.abs(free["x"] - closed(curved)["x"]).max() < 1e-9


def test_limited_allocates_among_what_is_fed_back(spirals, curved):
    """F has the slack of its row: its sum is held meanwhile, and where limits are wide nothing changes."""
    body = spirals.model.reduction.mechanism
    heavy, wide, narrow = machine(spirals), sv.plant(body, limits={"fx": 9.0, "fy": 9.0}), sv.plant(body, limits={"fx": 1.0, "fy": 1.0})
    assert np.array_equal(closed(sv.limited(curved, wide), heavy).commands, closed(curved, heavy).commands)
    within = sv.plant(body, m=1.1, limits={"fx": 1.0, "fy": 1.0})
    orders = (["speed", "kappa"], ["kappa", "speed"])
    loops = [closed(sv.limited(curved, narrow, priority=order), within) for order in orders]
    for loop in loops:
        assert abs(loop.signal["integral of kappa"][-1]) < 0.03 and np.abs(loop.inputs).max() <= 1.0
    slacks = [np.abs(loop.signal["slack speed"]).max() for loop in loops]
    assert 0.1 < slacks[0] < 0.9 * slacks[1]
    plan = jerk()
    with refused(SpecificationError, "Leave out sv.limited", name="jerk", order=3):
        sv.limited(sv.lqr(plan, sv.plant(plan.model.reduction.mechanism)), sv.plant(plan.model.reduction.mechanism, limits={"fx": 9.0}))


def test_limited_needs_no_row_of_the_state():
    """Where all rows have order 2, slack is that of their accelerations."""
    body, _ = particle()
    ax, ay = body.q.d(2)
    plan = planned(body, sv.Program({"a": ax - 1.0, "b": ay - 0.5}), (0.0, 1.0), x=0.0, y=0.0, dx=0.0, dy=0.0)
    law = sv.limited(sv.lqr(plan, sv.plant(body)), sv.plant(body, limits={"fx": 1.02}))
    loop = closed(law)
    assert loop["fx"].max() <= 1.02 and loop.signal["slack a"].min() < -1.0 and np.abs(loop.signal["slack b"]).max() < 1e-9
    assert abs(loop.residual["a"][0, -1]) == pytest.approx(1 - 1.02 / 1.1, rel=1e-6)


# elsewhere -------------------------------------------------------------------------------------------------------


def test_in_c(curved, tmp_path, c_compiler):
    loop = closed(curved, span=(0.0, 10.0), sensors=sv.Sensors({"dx": 1e-4, "dy": 1e-4}, seed=2))
    ours = InC(curved, tmp_path)
    step = ours.start()
    commands = [step(t, dict(zip(curved.measures, y, strict=True))) for t, y in zip(loop.t, loop.measurements.T, strict=True)]
    assert len(loop.t) == 10001 and close_to(np.array(commands).T, loop.commands)
    assert close_to(np.array(ours.states[:-1]).T, loop.controller_states)


def test_in_lanes_and_in_python_control(curved):
    control = pytest.importorskip("control")
    loop = closed(curved)
    many = sv.close_many(loop, {"m": [1.0, 1.1, 1.2]}, record=["x", "fy"], every=10)
    assert np.abs(many.trace["x"][:, 1] - loop["x"][::10]).max() < 1e-12
    assert np.abs(many.trace["fy"][:, 1] - loop["fy"][::10]).max() < 1e-11
    bounds = {"fx": 1.0, "fy": 1.0}
    within = sv.plant(curved.plan.model.reduction.mechanism, m=1.1, limits=bounds, rate_limits=bounds)
    aware = sv.computed(curved.plan, within, rate=1000.0, poles={"kappa": SLOW, "speed": SLOW})
    plan, jerky = mass([-8.0, -10.0, -13.0])
    held = sv.lqr(plan, sv.plant(plan.model.reduction.mechanism), rate=1000.0, integral={"jerk": 1e4})
    for law, plant in ((aware, within), (sv.limited(curved, within), within), (jerky, machine(plan)), (held, machine(plan))):
        loop, name = closed(law, plant), law.inputs[0]
        heavier = sv.plant(plant.mechanism, m=1.2, limits=plant.limits, rate_limits=plant.rate_limits)
        many, alone = sv.close_many(loop, {"m": [1.0, 1.2]}, record=["x", name]), closed(law, heavier)
        assert np.abs(many.trace["x"][:, 1] - alone["x"]).max() < 1e-12 * max(np.abs(alone["x"]).max(), 1.0)
        assert np.abs(many.trace[name][:, 1] - alone[name]).max() < 1e-11
    short = closed(curved, span=(0.0, 0.1))
    system = nlsys(short)
    found = control.input_output_response(system, short.t, np.zeros((system.ninputs, len(short.t))), start(short))
    assert np.abs(found.outputs[0] - short["x"]).max() < 1e-12
    at_rest = np.concatenate([np.zeros(4), start(short)[4:]])  # where a curvature has no value
    with refused(ServoError, "returned NaN", name="computed", t=0.0):
        control.input_output_response(system, short.t, np.zeros((system.ninputs, len(short.t))), at_rest)


def test_internal_dynamics_are_those_of_what_is_fed_back():
    """The three neutral states of a jerk's errors are none of them; the roll of an aircraft is."""
    mechanism, program = gallery["two-cars"].build()
    (name, row), *_ = program.residuals.items()
    model = sv.derive(mechanism, sv.Program({name: mechanism.q.dt(row, 3)}))
    with pytest.warns(RuntimeWarning, match="unstable over these 4 s"):
        plan = sv.simulate(model, model.start(), (0.0, 4.0))
    law = sv.computed(plan, sv.plant(mechanism), rate=1000.0)
    assert law.info["orders"] == {name: 4}
    mechanism, program = vtol("centre")
    rows = {name: mechanism.q.dt(row, 3) if i == 0 else row for i, (name, row) in enumerate(program.residuals.items())}
    model = sv.derive(mechanism, sv.Program(rows))
    with pytest.warns(RuntimeWarning, match="unstable"):
        plan = sv.simulate(model, model.start(), (0.0, 0.5))
    with refused(UnstableInternalDynamics, "lqr"):
        sv.computed(plan, sv.plant(mechanism))


def test_a_lag_measures_what_it_delays(spirals):
    """Behind lags the accelerations of F are the model's: one pole more sums measured ones. -2 δ c/p is left."""
    lag = {"fx": 0.05, "fy": 0.05}
    law = sv.computed(spirals, sv.plant(spirals.model.reduction.mechanism, lag=lag), rate=1000.0, poles=0.2)
    assert law.info["orders"] == {"kappa": 2, "speed": 2}
    heavy = sv.plant(spirals.model.reduction.mechanism, m=1.1, lag=lag)
    begun = np.append(spirals.state(0.0), [spirals["fx"][0], spirals["fy"][0]])
    loop = sv.close(heavy, law, begun, spirals.span)
    assert loop.residual["kappa"][0, -1] == pytest.approx(-0.02, rel=0.02)


def test_a_lag_measures_a_row_of_accelerations():
    """A row of order 2 behind lags is the model's, too: without a sum of what is measured 10 % of it are lost."""
    body, _ = particle()
    plan = planned(body, sv.Program({"a": body.q.d(2)[0] - 1.0, "level": body.q[1]}), (0.0, 1.0), x=0.0, dx=0.0)
    lag = {"fx": 0.02, "fy": 0.02}
    law = sv.computed(plan, sv.plant(body, lag=lag), rate=500.0, poles=0.1)
    assert law.info["orders"] == {"a": 2, "level": 3}
    begun = np.append(plan.state(0.0), [plan["fx"][0], plan["fy"][0]])
    loop = sv.close(sv.plant(body, m=1.1, lag=lag), law, begun, plan.span)
    assert abs(loop.residual["a"][0, -1]) < 3e-4


# which F ---------------------------------------------------------------------------------------------------------


def test_an_integral_is_found_where_it_was_written():
    body, place = particle()
    (x, y), q = place.elements(), body.q
    for row, F in ((np.float64(1.5) - q.dt(x, 3), -x), (2 * q.dt(x, 3) - 3.0, 2 * x), (q.dt(x, 3) / 4 + np.float64(1.0), x / 4),
                   (q.dt(x, 3) * np.float64(0.5), 0.5 * x), (q.dt(x, 3) - 2.0, x), (1.0 - q.dt(q.dt(x), 2), -x), (q.dt(place, 3)[1] + q.t, y), (q.dt(x, 3) - q.dt(y, 3), x - y)):  # fmt: skip
        found = integrals(q, sv.Program({"row": row}))
        assert ca.is_equal(ca.simplify(found["row"] - F), ca.SX(0)) or ca.is_equal(found["row"], F, 3)
    assert not integrals(q, sv.Program({"row": q.dt(x, 3) - y})) and not integrals(q, sv.Program({"row": q.d(3)[0]}))
    slowed = sv.Program({"row": q.dt(x**2, 3) - 1.0}).slowed(q, 2.0)
    assert integrals(q, slowed)


def test_bad_input(spirals, curved):
    body, place = particle()
    x, y = place.elements()
    q, rows, at_rest = body.q, {"level": y}, {"x": 0.0, "dx": 0.0}
    plant = sv.plant(spirals.model.reduction.mechanism)
    for poles in ([], [-5.0] * 3, [-5 + 1j]):
        with refused(SpecificationError, "takes 1 or 2 poles", name="kappa", order=1):
            sv.computed(spirals, plant, poles={"kappa": poles, "speed": SLOW})
    with refused(SpecificationError, "left half plane", name="kappa"):
        sv.computed(spirals, plant, poles={"kappa": [5.0], "speed": SLOW})
    with refused(SpecificationError, "2000 1/s", name="kappa", bound=pytest.approx(2.0)):
        sv.computed(spirals, plant, rate=1000.0, poles={"kappa": [-2001.0], "speed": SLOW})
    with refused(SpecificationError, "twice", name="kappa"):
        sv.computed(spirals, plant, poles={"kappa": SLOW, "kappa_residual": SLOW, "speed": SLOW})
    with refused(SpecificationError, "twice", name="jerk"):
        sv.Program({"jerk": q.d(3)[0]}, integrals={"jerk": x, "jerk_residual": x})
    with refused(NameUnknown, name="jerky"):
        sv.Program({"jerk": q.d(3)[0]}, integrals={"jerky": x})
    with refused(SpecificationError, "slope", "sv.lqr", name="jerk", jet="dx"):
        sv.derive(body, sv.Program(rows | {"jerk": q.d(3)[0] - 1.0}, integrals={"jerk": x**2}))
    with refused(SpecificationError, "depends on no coordinates", name="jerk", order=-1):
        sv.derive(body, sv.Program(rows | {"jerk": q.d(3)[0] - 1.0}, integrals={"jerk": q.t}))
    bare = planned(body, sv.Program(rows | {"jerk": q.d(3)[0] - 1.0}), (0.0, 0.2), **at_rest)
    with refused(SpecificationError, "sv.lqr", name="jerk", order=3):
        sv.computed(bare, sv.plant(body))
    rough = sv.Program(rows | {"jerk": q.d(3)[0] - 1.0}, integrals={"jerk": q.d(1)[0] ** 2 / q.d(1)[0]})
    with refused(SpecificationError, "sv.lqr", name="jerk", t=0.0):
        sv.computed(planned(body, rough, (0.0, 0.2), **at_rest), sv.plant(body))
    hole = q[0] + ca.sqrt((q.t - 0.051) ** 2 - 1e-10)  # no value at one sample
    holed = planned(body, sv.Program(rows | {"jerk": q.d(3)[0] - 1.0}, integrals={"jerk": hole}), (0.0, 0.2), **at_rest)
    with refused(SpecificationError, "sv.lqr", name="jerk", t=pytest.approx(0.051)):
        sv.computed(holed, sv.plant(body), rate=1000.0)
    bent = planned(body, sv.Program(rows | sv.programs.acceleration_norm("a", q, ca.vertcat(x, y), 2.0)), (0.0, 0.2), **at_rest)
    with refused(SpecificationError, "'a' is not affine", "sv.lqr", name="a"):
        sv.computed(bent, sv.plant(body))
    with refused(SpecificationError, "order 2", name="kappa"):
        sv.lqr(spirals, plant, integral={"kappa": 1.0})


def test_a_decoupling_that_loses_its_rank_is_refused():
    times = np.linspace(0.0, 1.0, 11)
    lost = np.eye(2)[:, :, None] * np.ones(11)
    lost[1, 1] = times - 0.5
    given = object.__new__(_Extension)
    vars(given).update(powers={"a": 1, "b": 0}, names=("a", "b"), along=(times, None), xi=ca.SX(0, 1), turns=False, levels=[], v=ca.SX(0, 1))
    given._at = lambda *_: (lost, np.abs(lost))
    given.controller_states = lambda *_: None
    with refused(SpecificationError, "singular at t = 0.5 s", "sv.lqr", t=0.5, names=("a", "b")):
        given.require_rank()
    lost[1, 1] += 0.04
    with refused(SpecificationError, "singular between t = 0.4 s and t = 0.5 s", "sv.lqr", t=pytest.approx(0.4)):
        given.require_rank()
