"""The same report and the same accelerations in other words: names, order, units, equivalent constraints; numbers."""

from contextlib import suppress
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import derived_alike, motion, signal

import servoctl as sv
from servoctl.errors import InconsistentStart, ServoError, SingularProgram
from servoctl.gallery import gallery, mass_on_car, overhead_crane, winch_crane
from servoctl.model.full import affirmed
from servoctl.model.model import Model, derive
from servoctl.model.variants import derived_near
from servoctl.reduction.appell import require_positive

TIMES = (0.7, 2.0, 4.4)
STARTS = {  # off the places where the gallery's starts have a pivot that vanishes
    "spiral": ({"x": 0.0, "y": 0.0, "dx": 0.8, "dy": 0.6, "d2y": 0.1}, {}),
    "constant-speed": ({"x": 0.0, "y": 0.0, "dy": -3.0}, {"dx": 4.0}),
}


def start_of(name):
    """Held values and guess for a start of a gallery scene."""
    return STARTS.get(name, (gallery[name].start, gallery[name].guess))


def orders(model):
    return [row.order for row in model.reduction.rows]


def crane(names="x l theta", unit=1.0, permutation=(0, 1, 2), residuals=None, quasi=False):
    """The overhead crane with other names, lengths in 1/unit metres, another order of coordinates, other residuals."""
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81 * unit)
    listed = names.split()
    q = sv.coordinates(" ".join(listed[i] for i in permutation))
    x, l, theta = (q.d(0)[permutation.index(i)] for i in range(3))
    if quasi:
        V = [[1 + theta**2, 0.3, 0], [0, 2, l], [0.1, 0, 1]]
        q = q.with_quasi_velocities("u v w", [V[i] for i in permutation])
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    start, end = ((a * unit, b * unit) for a, b in ((0.0, 4.0), (5.0, 2.0)))
    path = sv.paths.rest_to_rest(start, end, duration=6.0, smoothness=5)
    r = q.references(X=path[0], Z=path[1])
    X, Z = load[0] - r.X, load[1] - r.Z
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load),
        potential=-p.m_load * p.g * load[1],
        actuators={"trolley": x, "hoist": l},
        parameters=p,
    )
    return mechanism, sv.Program({"X": X, "Z": Z} if residuals is None else residuals(q, X, Z))


def forces(model, unit=1.0, length="l"):
    found = []
    for t in TIMES:
        u = signal(model, "actuation", t, motion(model, t, guess={length: 4.0 * unit}))
        found.append([u["trolley"] / unit, u["hoist"] / unit])
    return np.array(found)


@pytest.fixture(scope="module")
def reference():
    return forces(derive(*crane()))


@pytest.mark.parametrize(
    ("options", "length"),
    [
        ({"permutation": (2, 0, 1)}, "l"),
        ({"names": "zeta a y"}, "a"),
        ({"unit": 1e3}, "l"),
        ({"unit": 1e-3, "permutation": (2, 1, 0)}, "l"),
        ({"residuals": lambda q, X, Z: {"X": 1e6 * X, "Z": Z}}, "l"),
        ({"residuals": lambda q, X, Z: {"X": 1e-6 * X, "Z": 1e6 * Z}}, "l"),
        ({"residuals": lambda q, X, Z: {"P": X + Z, "M": X - Z}}, "l"),
        ({"residuals": lambda q, X, Z: {"Z": Z, "X": X}}, "l"),
        ({"residuals": lambda q, X, Z: {"X": X * (2 + q.d(0)[2] ** 2), "Z": Z + 1000 * X}}, "l"),
        ({"quasi": True}, "l"),
        ({"quasi": True, "permutation": (1, 2, 0), "unit": 1e3}, "l"),
    ],
)
def test_the_crane_is_the_same_in_other_words(options, length, reference):
    model = derive(*crane(**options))
    assert orders(model) == [0, 0, 0] and model.flat
    assert set(model.reduction.needs.values()) == {4}
    assert len(model.reduction.hidden) >= 1 and model.reduction.rank.clear
    assert forces(model, options.get("unit", 1.0), length) == pytest.approx(reference, rel=1e-9)


def test_scaled_specifications_get_the_same_report():
    reports = []
    for options in ({}, {"unit": 1e3}, {"unit": 1e-3}, {"residuals": lambda q, X, Z: {"X": 1e6 * X, "Z": Z}}):
        r = derive(*crane(**options)).reduction
        derivations = [(row.name, row.order, row.derivation) for row in r.rows]
        reports.append((derivations, r.needs, r.top, r.realisation.dependent))
    assert all(report == reports[0] for report in reports)


@pytest.mark.parametrize("both", [True, False])
def test_a_constraint_replaced_by_its_derivative_is_one_order_higher(both, reference):
    model = derive(*crane(residuals=lambda q, X, Z: {"X": q.dt(X), "Z": q.dt(Z) if both else Z}))
    plain = derive(*crane())
    assert model.free == plain.free + 1 + both
    assert model.reduction.needs == {"X": 3, "Z": 4 - both}
    for t, expected in zip(TIMES, reference, strict=True):
        state = plain.start(t, guess={"l": 4.0})
        jets = motion(model, t, guess=dict(zip(state.names, state.values, strict=True)))
        assert jets[:6] == pytest.approx(state.values, abs=1e-8)
        assert list(signal(model, "actuation", t, jets).values()) == pytest.approx(expected, rel=1e-7)


def test_a_second_derivative_is_two_orders_higher():
    model = derive(*crane(residuals=lambda q, X, Z: {"X": q.dt(X, 2), "Z": q.dt(Z, 2)}))
    assert model.free == 4 and model.reduction.needs == {"X": 2, "Z": 2}


@pytest.mark.parametrize("scale", [1e6, -1e-6])
@pytest.mark.parametrize(
    "name", ["appell-hamel", "spiral", "constant-speed", "mass-on-car", "vtol", "winch-crane-redundant"]
)
def test_scaled_constraints_leave_the_gallery_as_it_is(name, scale, gallery_model):
    mechanism, program = gallery[name].build()
    first, *rest = program.residuals
    scaled = {first: scale * program.residuals[first]} | {key: program.residuals[key] for key in rest}
    model, plain = derive(mechanism, sv.Program(scaled, by=program.by)), gallery_model(name)
    assert orders(model) == orders(plain)
    assert model.reduction.needs == plain.reduction.needs
    assert model.reduction.realisation.dependent == plain.reduction.realisation.dependent
    (held, guess), t = start_of(name), 0.3
    jets = [motion(m, t, guess=guess, **held) for m in (model, plain)]
    assert jets[0] == pytest.approx(jets[1], rel=1e-9, abs=1e-9)
    kind = "actuation" if program.by == "actuators" else "reaction"
    u = [list(signal(m, kind, t, jets[0]).values()) for m in (model, plain)]
    assert u[0] == pytest.approx(u[1], rel=1e-9, abs=1e-9)


def test_the_3d_crane_in_millimetres_and_in_another_order_is_flat(gallery_model):
    q = sv.coordinates("phi l y theta x")
    phi, l, y, theta, x = q
    p = sv.parameters(m_bridge=20.0, m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9810.0)
    rope = ca.vertcat(ca.sin(theta), ca.cos(theta) * ca.sin(phi), ca.cos(theta) * ca.cos(phi))
    load = ca.vertcat(x, y, 0) + l * rope
    bodies = ((p.m_bridge, x), (p.m_trolley, y), (p.m_hoist, l), (p.m_load, load))
    s = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, duration=6.0, smoothness=6)).s
    turn = sv.curves.circle(np.pi / 2 * (s - 1), centre=(0.0, 3000.0), radius=3000.0)
    path = ca.vertcat(turn, sv.curves.line(s, 5000.0, 3000.0))
    mechanism = sv.Mechanism(
        q,
        gibbs=sum(sv.particle(q, m, position) for m, position in bodies),
        potential=-p.m_load * p.g * load[2],
        actuators={"bridge": x, "trolley": y, "hoist": l},
        parameters=p,
    )
    model = derive(mechanism, sv.Program({name: load[i] - path[i] for i, name in enumerate("XYZ")}))
    assert orders(model) == [0] * 5 and set(model.reduction.needs.values()) == {4}
    plain = gallery_model("crane-3d")
    for t in (1.1, 4.0):
        found = signal(model, "actuation", t, motion(model, t, guess={"l": 5000.0}))
        expected = signal(plain, "actuation", t, motion(plain, t, guess={"l": 5.0}))
        assert {k: v / 1000 for k, v in found.items()} == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    ("name", "guess"),
    [
        ("overhead-crane", ({"l": 4.0}, {"l": 4.0, "Z": 4.0})),
        ("winch-crane", ({"beta": 40.0}, {"beta": 40.0, "Z": 4.0})),
        ("crane-3d", ({"l": 5.0}, {"l": 5.0, "Z": 5.0})),
    ],
)
def test_relative_and_redundant_coordinates_give_equal_forces(name, guess, gallery_model):
    models = gallery_model(name), gallery_model(f"{name}-redundant")
    for t in (0.9, 3.0, 5.2):
        u = [signal(model, "actuation", t, motion(model, t, guess=g)) for model, g in zip(models, guess, strict=True)]
        assert u[0] == pytest.approx(u[1], rel=1e-8)


def test_mass_on_car_in_both_coordinates_gives_equal_forces(gallery_model):
    relative, absolute = gallery_model("mass-on-car"), gallery_model("mass-on-car-absolute")
    jets = motion(relative, 1.2, s=0.3, ds=-0.4)
    z = dict(zip(relative.jet_names, jets, strict=True))
    same = motion(absolute, 1.2, x=z["x"], dx=z["dx"])
    u = [signal(m, "actuation", 1.2, z)["force"] for m, z in ((relative, jets), (absolute, same))]
    assert u[0] == pytest.approx(u[1], rel=1e-11)


def test_the_planar_cranes_agree():
    """Blajer's winch is a hoist of inertia J/r² and length r·beta."""
    mechanism, _ = overhead_crane()
    (x, l, theta), q, p = mechanism.q, mechanism.q, mechanism.parameters
    path = sv.paths.rest_to_rest((0.0, 4.0), (1.0, 5.0), duration=6.0, smoothness=6)
    r = q.references(across=path[0], below=path[1])
    program = {"X": x + l * ca.sin(theta) - r.across, "Z": l * ca.cos(theta) - r.below}
    hoist = derive(mechanism, sv.Program(program)).with_parameters(m_hoist=0.1 / 0.1**2)
    winch = derive(*winch_crane())
    u = signal(hoist, "actuation", 2.5, motion(hoist, 2.5, guess={"l": 4.0}))
    v = signal(winch, "actuation", 2.5, motion(winch, 2.5, guess={"beta": 40.0}))
    assert (v["trolley"], v["winch"]) == pytest.approx((u["trolley"], 0.1 * u["hoist"]), rel=1e-10)
    assert p.names


# numbers at run time -------------------------------------------------------------------------------------------------


def cars_with_friction(friction):
    p = sv.parameters(m=1.0, k=1.0, c=friction)
    q = sv.coordinates("x1 x2")
    (x1, x2), (v1, v2) = q, q.d(1)
    path = q.references(X=sv.paths.rest_to_rest(0.5, 2.5, duration=2.0, smoothness=6)).X
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m, x1) + sv.particle(q, p.m, x2),
        potential=p.k * (x1 - x2) ** 2 / 2,
        forces={"x1": -p.c * v1, "x2": -p.c * v2},
        actuators={"f": x2},
        parameters=p,
    )
    return derive(mechanism, sv.Program({"X": x1 - path}))


def coupled(coupling):
    p = sv.parameters(e=coupling)
    q = sv.coordinates("a b c")
    (a, b, c), (dda, ddb, ddc) = q, q.d(2)
    S = (dda**2 + ddb**2 + ddc**2) / 2 + p.e * (dda * ddb + ddb * ddc)
    U = a**2 + b**2 + c**2
    mechanism = sv.Mechanism(q, gibbs=S, potential=U, actuators={"f": a, "g": b}, parameters=p)
    return derive(mechanism, sv.Program({"A": a - ca.sin(q.t), "B": b - ca.cos(q.t)}))


def test_other_numbers_need_no_other_derivation():
    model = cars_with_friction(0.2)
    changed, derived = model.with_parameters(c=0.7, m=1.5), cars_with_friction(0.7).with_parameters(m=1.5)
    u = [signal(m, "actuation", 1.2, motion(m, 1.2))["f"] for m in (changed, derived)]
    assert u[0] == pytest.approx(u[1], rel=1e-12)
    assert model.parameters == pytest.approx([1.0, 1.0, 0.2])


@pytest.mark.parametrize(
    ("build", "special", "changes", "held"),
    [
        (cars_with_friction, 0.0, {"c": 0.7}, {}),
        (coupled, 0.0, {"e": 0.3}, {"c": 0.3, "dc": 0.1}),
        (lambda alpha: derive(*mass_on_car(alpha=alpha)), 0.0, {"alpha": 0.3}, {"s": 0.1, "ds": 0.0}),
        (lambda d: derive(*mass_on_car(alpha=0.0, damping=d)), 0.0, {"d": 1.0}, {}),
        (lambda alpha: derive(*mass_on_car(alpha=alpha)), 0.3, {"alpha": 0.0}, {}),
        (lambda d: derive(*mass_on_car(alpha=0.0, damping=d)), 1.0, {"d": 0.0}, {}),
    ],
    ids=["friction from 0", "coupling from 0", "angle from 0", "damping from 0", "angle to 0", "damping to 0"],
)
def test_a_parameter_that_was_special_at_derivation_is_not_forgotten(build, special, changes, held):
    """The motion is that of a fresh derivation with the new number, or an error says that one is due."""
    model, fresh = build(special), build(*changes.values())
    t = 1.2
    try:
        changed = model.with_parameters(**changes)
        jets = motion(changed, t, guess=held)
        u = signal(changed, "actuation", t, jets)
    except ServoError:
        return
    assert changed.free == fresh.free
    assert u == pytest.approx(signal(fresh, "actuation", t, motion(fresh, t, guess=held)), rel=1e-9)


def test_masses_that_become_zero_at_run_time_are_refused(gallery_model):
    with pytest.raises(ServoError):
        model = gallery_model("passive-arm").with_parameters(m=0.0, I=0.0)
        motion(model, 1.0, q2=0.1, dq2=0.0)


@pytest.mark.parametrize(
    "name",
    [
        "appell-hamel", "overhead-crane", "two-cars-ideal", "mass-on-car-absolute", "spiral", "constant-speed",
        "constant-speed-horizontal", "passive-arm", "vtol-centre",
    ],
)  # fmt: skip
def test_a_model_near_a_state_is_the_same_model(name, gallery_model):
    """Pivots chosen again for one state of the motion: same orders, same accelerations, same actuation."""
    (held, guess), model, t = start_of(name), gallery_model(name), 0.3
    jets = motion(model, t, guess=guess, **held)
    near = derived_near(model, t, jets)
    assert orders(near) == orders(model)
    kind = "actuation" if model.reduction.program.by == "actuators" else "reaction"
    expected = signal(model, kind, t, jets)
    assert signal(near, kind, t, jets) == pytest.approx(expected, rel=1e-8, abs=1e-8)
    x = jets[: len(model.state_names)]
    rates = [m.function("ode")(t, x, m.p)[: len(x)] for m in (model, near)]
    assert rates[0] == pytest.approx(rates[1], rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("name", STARTS)
def test_a_start_where_a_pivot_vanishes_gets_pivots_of_its_own(name, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    state = model.start(0.0, guess=scene.guess, **scene.start)
    near = derived_near(model, 0.0, np.append(state.values, np.zeros(model.n)))
    rates = near.function("ode")(0.0, state.values, model.p)[: len(state.values)]
    assert np.all(np.isfinite(rates))
    reaction = signal(near, "reaction", 0.0, np.append(state.values, rates[-model.n :]))
    assert np.all(np.isfinite(list(reaction.values())))


AFFIRMED = ("overhead-crane", "winch-crane", "appell-hamel", "mass-on-car", "vtol", "wheeled-robot")


@pytest.mark.parametrize("name", AFFIRMED)
def test_new_numbers_are_affirmed_by_a_few_evaluations(name, gallery_model, monkeypatch):
    """Nothing is derived again."""
    model = gallery_model(name)
    changed = {name: 1.1 * value if value else 0.1 for name, value in model.numbers.items()}
    monkeypatch.setattr(Model, "_of", lambda *_: pytest.fail("derived again"))
    for name, value in changed.items():
        other = model.with_parameters(**{name: value})
        assert other._functions is model._functions and other.numbers[name] == value


EXTREMES = (0.0, 1e-13, 1e-9, 1e-6, 0.1, 3.0, 100.0, -1.0)
CHANGED = {
    "friction": lambda: cars_with_friction(0.2),
    "no friction": lambda: cars_with_friction(0.0),
    "coupled": lambda: coupled(0.3),
    "uncoupled": lambda: coupled(0.0),
    "horizontal": lambda: derive(*mass_on_car(alpha=0.0, damping=1.0)),
    "inclined": lambda: derive(*mass_on_car(alpha=0.3)),
}


@pytest.mark.parametrize("name", CHANGED)
def test_what_is_affirmed_is_what_a_derivation_with_these_numbers_gives(name):
    """Numbers that change ranks, orders or the sign of a mass lead to another derivation, ordinary ones do not."""
    model, both = CHANGED[name](), 0
    r = model.reduction
    for parameter, value in model.numbers.items():
        for factor in EXTREMES:
            values = r.mechanism.parameters.values({**model.numbers, parameter: (value or 1.0) * factor})
            if affirmed(model, values[:, None])[0]:
                require_positive(r.mechanism, replace(r.points, values=values))
                with suppress(SingularProgram):  # where a slope of 1e-13 is neither zero nor not
                    assert derived_alike(model, values)
                both += 1
    assert both >= 5


def test_a_number_at_which_a_row_has_a_pole_is_refused(gallery_model):
    """A robot that follows a clothoid at speed zero: its rows divide by the speed, and hold wherever v/v is one."""
    with pytest.raises(InconsistentStart):
        gallery_model("wheeled-robot").with_parameters(speed=0.0)


@pytest.mark.parametrize(("name", "change"), [("no friction", {"c": 0.7}), ("horizontal", {"alpha": 0.3})])
def test_what_was_special_at_derivation_is_not_affirmed(name, change):
    model = CHANGED[name]()
    values = model.reduction.mechanism.parameters.values({**model.numbers, **change})
    assert not affirmed(model, values[:, None])[0] and not derived_alike(model, values)
