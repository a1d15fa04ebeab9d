"""Bad input: one test for each rule, with the error's type and its facts."""

import math
import warnings

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import (
    InconsistentStart,
    NameUnknown,
    NotRealisable,
    ServoError,
    SingularProgram,
    SpecificationError,
)
from servoctl.gallery import cars, mass_on_car, overhead_crane, spiral, vtol
from servoctl.model.equations import invariant_names
from servoctl.model.model import derive
from servoctl.simulation import simulate


def stopped(kind, facts, make):
    """The error that `make` raises, of this type, with these facts in its text."""
    with refused(kind, *facts) as caught:
        make()
    return caught.value


def plane(**options):
    q = sv.coordinates("x y")
    x, y = q
    options = {"actuators": {"pull": x, "lift": y}} | options
    return q, sv.Mechanism(q, gibbs=sv.particle(q, 2.0, (x, y)), **options)


# the specification ---------------------------------------------------------------------------------------------------


def test_fewer_actuators_than_constraints():
    q, mechanism = plane(actuators={"pull": (1, 1)})
    x, y = q
    program = sv.Program({"east": x - ca.sin(q.t), "north": y})
    facts = ["2 residuals", "east", "north", "1 independent", "pull", "by='ideal'"]
    error = stopped(NotRealisable, facts, lambda: derive(mechanism, program))
    assert error.details["residuals"] == ["east", "north"] and error.details["actuators"] == ["pull"]


def test_no_actuators_at_all():
    q, mechanism = plane(actuators=None)
    program = sv.Program({"east": next(iter(q)) - ca.sin(q.t)})
    stopped(NotRealisable, ["1 residual", "east", "none"], lambda: derive(mechanism, program))


@pytest.mark.parametrize("power", [3, 4])
def test_a_gibbs_function_that_is_not_quadratic(power):
    q = sv.coordinates("x y")
    ddx, ddy = q.d(2)
    facts = ["Gibbs function", "not quadratic", "sv.particle"]
    stopped(SpecificationError, facts, lambda: sv.Mechanism(q, gibbs=ddx**2 + ddy**power))


@pytest.mark.parametrize("where", ["gibbs", "potential", "forces", "actuators", "constraints", "outputs"])
def test_a_foreign_symbol_in_a_mechanism(where):
    q = sv.coordinates("x y")
    x, y = q
    wind = ca.SX.sym("wind")
    S = sv.particle(q, 1.0, (x, y))
    foreign = {
        "gibbs": {"gibbs": S * wind},
        "potential": {"potential": wind * x},
        "forces": {"forces": {"x": wind}},
        "actuators": {"actuators": {"a": wind * x}},
        "constraints": {"constraints": {"rail": y - wind}},
        "outputs": {"outputs": {"o": wind}},
    }[where]
    error = stopped(SpecificationError, ["'wind'", "symbol"], lambda: sv.Mechanism(q, **({"gibbs": S} | foreign)))
    assert error.details["name"] == "wind"


def test_a_foreign_symbol_in_a_program():
    q, mechanism = plane()
    program = sv.Program({"east": next(iter(q)) - ca.SX.sym("target")})
    error = stopped(SpecificationError, ["'east'", "'target'"], lambda: derive(mechanism, program))
    assert error.details["name"] == "target"


def test_a_symbol_of_the_same_name_is_another_one():
    q, mechanism = plane()
    twin = next(iter(sv.coordinates("x")))
    program = sv.Program({"east": twin - q.t})
    error = stopped(SpecificationError, ["'east'", "'x'", "another one"], lambda: derive(mechanism, program))
    assert error.details["name"] == "x"


def test_parameters_that_the_mechanism_was_not_given():
    p = sv.parameters(m_load=1.0)
    q = sv.coordinates("x")
    (x,) = q
    stopped(SpecificationError, ["'m_load'", "parameters="], lambda: sv.Mechanism(q, gibbs=sv.particle(q, p.m_load, x)))


def test_a_misspelt_symbol_shows_the_nearest():
    p = sv.parameters(m_load=1.0)
    q = sv.coordinates("x")
    (x,) = q
    S = sv.particle(q, ca.SX.sym("m_laod"), x)
    stopped(SpecificationError, ["'m_laod'", "m_load"], lambda: sv.Mechanism(q, gibbs=S, parameters=p))


@pytest.mark.parametrize("by", ["ideal", "actuators"])
def test_dependent_constraints(by):
    q, mechanism = plane()
    x, y = q
    program = sv.Program({"one": x - ca.sin(q.t), "other": 2 * x - 2 * ca.sin(q.t)}, by=by)
    error = stopped(SpecificationError, ["one", "other", "dependent"], lambda: derive(mechanism, program))
    assert set(error.details["rows"]) == {"one", "other"}


@pytest.mark.parametrize("by", ["ideal", "actuators"])
def test_contradictory_constraints(by):
    q, mechanism = plane()
    x, y = q
    program = sv.Program({"one": x - ca.sin(q.t), "other": x - 1 - ca.sin(q.t)}, by=by)
    error = stopped(SpecificationError, ["one", "other", "contradict"], lambda: derive(mechanism, program))
    assert set(error.details["rows"]) == {"one", "other"}


def test_material_constraints_that_depend_or_contradict():
    for second, word in ((lambda y: 3 * y - 3, "dependent"), (lambda y: y - 2, "contradict")):
        q = sv.coordinates("x y")
        x, y = q
        constraints = {"rail": y - 1, "guide": second(y)}
        mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"a": x}, constraints=constraints)
        program = sv.Program({"east": x - ca.sin(q.t)})
        stopped(SpecificationError, ["rail", "guide", word], lambda m=mechanism, p=program: derive(m, p))


def test_a_program_that_no_actuator_can_realise():
    q = sv.coordinates("x y z")
    x, y, z = q
    S = sv.particle(q, 1.0, (x, y, z))
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"pull": x, "push": y})
    program = sv.Program({"height": z - ca.sin(q.t), "east": x})
    error = stopped(NotRealisable, ["height", "actuator"], lambda: derive(mechanism, program))
    assert "height" in error.details["rows"]


def test_a_program_that_only_gravity_could_realise():
    q = sv.coordinates("x z")
    x, z = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, z)), potential=9.81 * z, actuators={"pull": x})
    program = sv.Program({"height": z - ca.sin(q.t)})
    stopped(NotRealisable, ["height"], lambda: derive(mechanism, program))


def test_a_path_that_is_not_smooth_enough():
    mechanism, _ = cars(2)
    q = mechanism.q
    path = q.references(car_1=sv.paths.rest_to_rest(0.5, 2.5, duration=2.0, smoothness=2, t_start=3.0)).car_1
    model = derive(mechanism, sv.Program({"car 1": next(iter(q)) - path}))
    start, said = model.start(), ["car_1", "needs C^4, has C^2 at t = 3"]
    error = stopped(SpecificationError, said, lambda: sv.simulate(model, start, (0.0, 4.0)))
    facts = {key: error.details[key] for key in ("name", "needs", "has")}
    assert facts == {"name": "car_1", "needs": 4, "has": 2} and error.details["t"] == pytest.approx(3.0)


def test_a_squared_constraint():
    q, mechanism = plane()
    x, _ = q
    program = sv.Program({"squared": (x - ca.sin(q.t)) ** 2}, by="ideal")
    error = stopped(SingularProgram, ["'squared'", "gradient"], lambda: derive(mechanism, program))
    assert error.details["row"] == "squared"


@pytest.mark.parametrize("mass", [0.0, "p"])
def test_a_singular_mass_matrix(mass):
    p = sv.parameters(m=0.0)
    q = sv.coordinates("x y")
    x, y = q
    S = sv.particle(q, 2.0, x) + sv.particle(q, p.m if mass == "p" else mass, y)
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"a": x}, parameters=p)
    program = sv.Program({"east": x - ca.sin(q.t)})
    error = stopped(SpecificationError, ["mass matrix is singular", "dy"], lambda: derive(mechanism, program))
    assert error.details["names"] == ["dy"] and "dx" not in str(error)


def test_a_direction_without_inertia_between_coordinates():
    q = sv.coordinates("x y z")
    x, y, z = q
    S = sv.particle(q, 2.0, x + y) + sv.particle(q, 1.0, z)
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"a": x})
    program = sv.Program({"east": x - ca.sin(q.t)})
    error = stopped(SpecificationError, ["singular", "dx", "dy"], lambda: derive(mechanism, program))
    assert set(error.details["names"]) == {"dx", "dy"}


def test_a_mass_that_a_material_constraint_carries_may_be_zero():
    """The redundant coordinate y has no mass of its own, but moves with x."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), actuators={"a": x}, constraints={"tie": x - y})
    assert derive(mechanism, sv.Program({"east": x - ca.sin(q.t)})).free == 0


def test_an_output_of_a_higher_order_than_the_motion_has_a_value():
    """A jerk, where the motion has jets up to the acceleration."""
    q = sv.coordinates("x y")
    (x, y), jerk = q, q.d(3)[0]
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), actuators={"a": x}, outputs={"jerk": jerk})
    model = derive(mechanism, sv.Program({"east": x - ca.sin(q.t)}))
    run = simulate(model, model.start(), (0.0, 0.3))
    assert run["jerk"] == pytest.approx(-np.cos(run.t), abs=1e-12)


# numpy and math on symbols -------------------------------------------------------------------------------------------

FOREIGN_FUNCTIONS = {
    "math.sin": lambda x, y: math.sin(x),
    "math.hypot": lambda x, y: math.hypot(x, y),
    "math.atan2": lambda x, y: math.atan2(y, x),
    "np.arctan2": lambda x, y: np.arctan2(y, x),
    "np.linalg.norm": lambda x, y: np.linalg.norm([x, y]),
    "np.array and norm": lambda x, y: np.linalg.norm(np.array([x, y])),
    "np.hypot": lambda x, y: np.hypot(x, y),
    "float": lambda x, y: float(x) + y,
    "np.float64": lambda x, y: np.float64(x) * y,
    "np.maximum": lambda x, y: np.maximum(x, y),
    "np.where": lambda x, y: np.where(x > 0, x, y),
    "round": lambda x, y: round(x),
    "an array of objects": lambda x, y: np.array([x, y], dtype=object),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
@pytest.mark.parametrize("name", FOREIGN_FUNCTIONS)
@pytest.mark.parametrize("where", ["residual", "position", "potential", "path"])
def test_functions_of_numpy_and_math_on_symbols_never_pass_in_silence(name, where):
    """Refused with the way out, or right where CasADi itself takes the function; what they raise is their own."""
    q = sv.coordinates("x y")
    x, y = q
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            value = FOREIGN_FUNCTIONS[name](x, y)
        except Exception as error:  # before servoctl sees anything
            assert "servoctl" not in type(error).__module__
            return
        make = {
            "residual": lambda: sv.Program({"east": value}).residuals["east"],
            "position": lambda: sv.particle(q, 1.0, value),
            "potential": lambda: sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=value).potential,
            "path": lambda: sv.curves.line(q.t, 0.0, value),
        }[where]
        try:
            result = make()
        except SpecificationError as error:
            assert any(way in str(error) for way in ("CasADi", "ca.", "scalar", "entries", "Sizes", "if_else")), error
            return
    f = ca.Function("f", [*q, *q.d(1), *q.d(2), q.t], [result])
    assert np.all(np.isfinite(np.array(f(*np.linspace(0.3, 0.9, 7)))))


@pytest.mark.parametrize("where", ["residual", "position", "potential"])
def test_nan_from_math_names_the_functions_to_use_instead(where):
    q = sv.coordinates("x y")
    x, y = q
    value = ca.SX(float("nan")) * x
    make = {
        "residual": lambda: sv.Program({"east": value}),
        "position": lambda: sv.particle(q, 1.0, value),
        "potential": lambda: sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=value),
    }[where]
    error = stopped(SpecificationError, ["NaN", "ca.sin", "math"], make)
    assert error.details["what"]


# numbers -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, None, "much", [1.0], ca.SX.sym("m")])
def test_numbers_of_parameters_that_are_none(value):
    stopped(SpecificationError, ["'m'", "finite number"], lambda: sv.parameters(m=value))
    model = derive(*cars(2))
    error = stopped(SpecificationError, ["'m1'", "finite number"], lambda: model.with_parameters(m1=value))
    assert error.details["name"] == "m1"


@pytest.mark.parametrize("value", [math.nan, math.inf, None, "far", [1.0, 2.0], 1j])
@pytest.mark.parametrize("how", ["held", "guess", "t", "derive"])
def test_numbers_of_a_start_that_are_none(value, how):
    mechanism, program = mass_on_car()
    model = derive(mechanism, program)
    make = {
        "held": lambda: model.start(s=value),
        "guess": lambda: model.start(guess={"s": value}),
        "t": lambda: model.start(value),
        "derive": lambda: derive(mechanism, program, guess={"s": value}),
    }[how]
    stopped(SpecificationError, ["t" if how == "t" else "s", repr(value)], make)


# names ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda m: m.start(thta=0.1), "theta"),
        (lambda m: m.start(guess={"thet": 0.1}), "theta"),
        (lambda m: m.start(dL=0.1), "dl"),
        (lambda m: m.start(d2theta=0.1), "dtheta"),
        (lambda m: m.with_parameters(m_laod=100.0), "m_load"),
        (lambda m: m.start(guess={"l": 4.0})["thetta"], "theta"),
        (lambda m: derive(*overhead_crane(), guess={"tetha": 0.0}), "theta"),
    ],
)
def test_unknown_names_show_the_nearest(make, match):
    model = derive(*overhead_crane())
    error = stopped(NameUnknown, [f"Nearest: {match!r}"], lambda: make(model))
    assert error.details["match"] == match and error.details["name"] != match
    assert set(error.details) == {"name", "valid", "match"}


@pytest.mark.parametrize("name", ["guess", "self", "t0", "held", "theta"])
def test_a_coordinate_of_any_name_can_be_held_or_is_refused_at_once(name):
    """`start(t, guess, **held)` has arguments of its own."""
    try:
        q = sv.coordinates(f"x {name}")
    except SpecificationError as error:
        assert repr(name) in str(error)
        return
    x, other = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, other)), actuators={"a": x})
    model = derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}), keep=[name])
    assert model.start(0.2, **{name: 0.3, f"d{name}": 0.0})[name] == 0.3


def test_names_that_resemble_nothing_list_the_valid_ones():
    error = stopped(NameUnknown, ["'qqq'", "theta", "dl"], lambda: derive(*overhead_crane()).start(qqq=1.0))
    assert error.details["match"] is None


@pytest.mark.parametrize("how", ["spiral", "cars", "vtol"])
def test_gallery_functions_refuse_what_they_do_not_know(how):
    make = {"spiral": lambda: spiral(1), "cars": lambda: cars(1), "vtol": lambda: vtol("tip")}[how]
    with pytest.raises(ServoError):
        make()


# starts --------------------------------------------------------------------------------------------------------------


def test_no_consistent_start_anywhere():
    q, mechanism = plane()
    x, y = q
    program = sv.Program({"circle": x**2 + y**2 + 1}, by="ideal")
    error = stopped(InconsistentStart, ["circle", "guess"], lambda: derive(mechanism, program))
    assert error.details["rows"] == ["circle"]


@pytest.mark.parametrize("scale, told", [(3.0, False), (1000.0, True)])
def test_a_path_in_millimetres_is_told_to_be_far_out_of_reach(scale, told):
    """Two links of 1 m reach 2 m; within a radian the hand moves by 3 m at most."""
    q = sv.coordinates("a b")
    a, b = q
    hand = ca.vertcat(ca.cos(a) + ca.cos(a + b), ca.sin(a) + ca.sin(a + b))
    arm = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, hand), actuators={"shoulder": a, "elbow": b})
    path = sv.paths.rest_to_rest((scale, scale), (0.9 * scale, scale), duration=2.0)
    r = q.references(X=path[0], Y=path[1])
    program = sv.Program({"X": hand[0] - r.X, "Y": hand[1] - r.Y})
    error = stopped(InconsistentStart, ["'Y'", "guess"], lambda: derive(arm, program).start())
    assert ("mm" in str(error)) is told
    assert not told or (scale - 2) / 4 < error.details["residual"] < 10 * scale


def test_no_consistent_start_at_this_time():
    """sin x = t holds until t = 1."""
    q, mechanism = plane()
    x, y = q
    model = derive(mechanism, sv.Program({"wave": ca.sin(x) - q.t, "north": y}), guess={"x": 0.3})
    assert model.start(0.5)["x"] == pytest.approx(np.arcsin(0.5))
    error = stopped(InconsistentStart, ["'wave'", "guess"], lambda: model.start(2.0))
    assert error.details["invariant"] == "wave" and error.details["residual"] > 1e-3


def test_a_held_value_against_an_invariant():
    model = derive(*overhead_crane())
    error = stopped(InconsistentStart, ["x = 3"], lambda: model.start(x=3.0, guess={"l": 4.0}))
    assert error.details["held"] == "x" and error.details["nearest_value"] == pytest.approx(0.0, abs=1e-9)
    assert error.details["invariant"] in str(error)


def test_a_held_velocity_against_an_invariant():
    model = derive(*mass_on_car())
    held = {"s": 0.0, "ds": 0.0, "dx": 2.0}
    error = stopped(InconsistentStart, ["dx = 2", "Nearest: dx = 0", "D(z)"], lambda: model.start(0.0, **held))
    assert error.details["held"] in ("dx", "ds") and error.details["invariant"] == "D(z)"


def test_held_values_that_agree_are_kept_exactly():
    model = derive(*mass_on_car())
    plain = model.start(0.5, s=0.1, ds=0.2)
    again = model.start(0.5, s=0.1, ds=0.2, x=plain["x"], dx=plain["dx"])
    assert again.values == pytest.approx(plain.values, abs=1e-12)
    assert set(again.held) == {"s", "ds", "x", "dx"} and again.free == ()
    assert (plain["s"], plain["ds"]) == (0.1, 0.2)


def test_a_start_says_what_was_held_and_what_was_free():
    state = derive(*mass_on_car()).start(0.0, guess={"s": 0.2}, ds=0.3)
    assert state.held == ("ds",) and state.free == ("s",)
    assert state["s"] == pytest.approx(0.2, abs=1e-9) and state["ds"] == 0.3
    assert len(repr(state).splitlines()) <= 12 and "held: ds" in repr(state)
    assert state.residual < 1e-10


def test_invariants_hold_at_every_level_of_a_start():
    model = derive(*overhead_crane())
    for t in (0.0, 1.7, 6.0, 9.0):
        state = model.start(t, guess={"l": 4.0})
        values = model.function("invariants")(t, state.values, model.p)[: len(invariant_names(model))]
        assert np.max(np.abs(values)) < 1e-10
        assert state.t == t and state.free == ()


def test_a_dict_is_no_start_of_a_program():
    mechanism, program = overhead_crane()
    model = derive(mechanism, program)
    with refused(SpecificationError, "'l'", "model.start(l=4.0)", names=["l"]):
        simulate(model, {"l": 4.0}, (0.0, 1.0))


def test_what_a_held_value_should_be_is_zero_where_it_is_rounding():
    mechanism, program = overhead_crane()
    with refused(InconsistentStart, "x = 1", "Nearest: x = 0.", held="x", nearest_value=0.0):
        derive(mechanism, program).start(x=1.0, l=4.0)
