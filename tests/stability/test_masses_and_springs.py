"""Masses, springs and guides of extreme numbers: an accurate answer, or a clear refusal."""

import casadi as ca
import closed_forms as cf
import numpy as np
import pytest
from conftest import relative
from refusals import refused

import servoctl as sv
from servoctl.gallery import cars, mass_on_car
from servoctl.methods.choice import as_method

RATIOS = (1e-8, 1e-4, 1e4, 1e8)


@pytest.fixture(scope="module")
def flat_cars():
    return sv.derive(*cars())


@pytest.fixture(scope="module")
def swinging_cars():
    return sv.derive(*cars(by="ideal"))


@pytest.fixture(scope="module")
def slider():
    return sv.derive(*mass_on_car(np.pi / 4, 1.0))


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_flat_program_bears_any_mass_ratio(ratio, flat_cars):
    model = flat_cars.with_parameters(m2=ratio)
    run = sv.simulate(model, model.start(), (0.0, 2.0))
    reference = cf.cars(run.t, masses=(1.0, ratio))
    assert relative(run["force"], reference["force"]) < 1e-11
    assert relative(run["x2"], reference["x2"]) < 1e-11


@pytest.mark.parametrize(("stiffness", "tolerance"), [(1e-3, 1e-11), (1e6, 1e-10), (1e9, 1e-7)])
def test_a_flat_program_bears_any_spring(stiffness, tolerance, flat_cars):
    """Rounding of x1 - x2, 1e-16 m, weighs 1e-7 N at 1e9 N/m; the force is some ten newtons."""
    model = flat_cars.with_parameters(k1=stiffness)
    run = sv.simulate(model, model.start(), (0.0, 2.0))
    reference = cf.cars(run.t, stiffnesses=(stiffness,))
    assert relative(run["force"], reference["force"]) < tolerance


@pytest.mark.parametrize("name", ["m_1", "m_2"])
@pytest.mark.parametrize("ratio", [1e4, 1e8])
def test_an_internal_motion_bears_heavy_masses(name, ratio, slider):
    model = slider.with_parameters(**{name: ratio})
    run = sv.simulate(model, model.start(s=0.0, ds=0.0), (0.0, 3.0), sv.methods.Adaptive(rtol=1e-11, atol=1e-13))
    reference = cf.mass_on_car(run.t, np.pi / 4, 1.0, **{name: ratio})
    assert relative(run["s"], reference["s"]) < 1e-8
    assert relative(run["force"], reference["force"]) < 1e-8


@pytest.mark.parametrize("mass", [1e-6])
def test_a_sliding_mass_that_hardly_weighs_follows_its_spring(mass, slider):
    """Its fast mode, -d/(m sin²α), has died out: d s' + k s = -m cosα z'' but for terms of the size of the mass."""
    model = slider.with_parameters(m_2=mass)
    start = model.start(s=0.0, ds=0.0)
    run = sv.simulate(model, start, (0.0, 3.0), method=sv.methods.Adaptive("Radau", rtol=1e-9, atol=1e-11 * mass))
    slow, _ = cf.response(run.t, (5.0, 1.0, 0.0), lambda t: -mass * np.sqrt(0.5) * acceleration(t), 3.0)
    assert relative(run["s"], slow) < 20 * mass + 1e-7
    force = acceleration(run.t)  # of the car alone, 1 kg
    assert relative(run["force"], force) < 20 * mass + 1e-5


def acceleration(t):
    return cf.rest_to_rest(t, 2, 0.5, 2.5, 3.0, 6)


SWING = {"x2": 1e-3, "dx2": 0.0}  # m: the spring of the second car is stretched by that


def swing(run, omega):
    """The first car hardly moves within a millisecond; the second swings freely."""
    return SWING["x2"] * np.cos(omega * run.t)


@pytest.mark.parametrize(("stiffness", "mass"), [(1e9, 2.0), (1.0, 2e-8)])
@pytest.mark.parametrize("method", ["DOP853", "Taylor", "Radau", "RK8"])
def test_a_fast_swing_is_followed(method, stiffness, mass, swinging_cars):
    model = swinging_cars.with_parameters(k1=stiffness, m2=mass)
    omega = np.sqrt(stiffness / mass)
    span = (0.0, 20.0 / omega)
    options = {"step": 0.1 / omega} if method == "RK8" else {"rtol": 1e-10, "atol": 1e-13}
    if method == "Radau":
        options = {"rtol": 1e-8, "atol": 1e-11}
    run = sv.simulate(model, model.start(**SWING), span, method=as_method(method, **options))
    error = np.abs(run["x2"] - swing(run, omega)).max() / SWING["x2"]
    assert error < (2e-5 if method == "Radau" else 1e-7)
    spring = stiffness * (run["x1"] - run["x2"] - 0.5)
    assert relative(run["reaction_x1"], spring) < 1e-6  # the first car rests: all its force is the spring's


@pytest.mark.parametrize("method", ["RK4", "RK8"])
def test_steps_too_long_for_a_stiff_spring_are_told(method, swinging_cars):
    model = swinging_cars.with_parameters(k1=1e9)
    with refused(sv.errors.IntegrationStopped, method, "0.001 s", "smaller step") as caught:
        sv.simulate(model, model.start(**SWING), (0.0, 2.0), method=as_method(method, step=1e-3))  # 22 rad per step
    assert caught.value.run is not None and not caught.value.run.success


# the guide of the mass on a car --------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [2e-7, 1e-6, 1e-5])
@pytest.mark.parametrize("how", ["derived", "changed"])
def test_a_guide_that_is_nearly_level_is_refused(how, alpha, slider):
    """Relative degree 3 or 2 is not for double precision to say: sin²α is 1e-10 or less."""
    with refused(sv.errors.SingularProgram, "z", "balance of s") as caught:
        sv.derive(*mass_on_car(alpha, 1.0)) if how == "derived" else slider.with_parameters(alpha=alpha)
    assert "Move the parameters" in str(caught.value)


@pytest.mark.parametrize("alpha", [1e-8, 5e-8])
@pytest.mark.parametrize("how", ["derived", "changed"])
def test_a_guide_that_is_level_up_to_rounding_is_level(how, alpha, slider):
    """What sin²α changes of the motion lies below its rounding, too."""
    model = sv.derive(*mass_on_car(alpha, 1.0)) if how == "derived" else slider.with_parameters(alpha=alpha)
    run = sv.simulate(model, model.start(s=0.0), (0.0, 3.0), method=sv.methods.Adaptive(rtol=1e-11, atol=1e-13))
    level = cf.mass_on_car(run.t, 0.0, 1.0)
    assert relative(run["s"], level["s"]) < 1e-9 and relative(run["force"], level["force"]) < 1e-9


@pytest.mark.parametrize("alpha", [1e-3])
def test_a_guide_that_is_hardly_inclined_follows_the_level_one(alpha, slider):
    """The fast mode -d/(m sin²α) has died out; s differs from the level guide's by terms in sin²α."""
    model = slider.with_parameters(alpha=alpha)
    start = model.start(s=0.0, ds=0.0)
    run = sv.simulate(model, start, (0.0, 3.0), method=sv.methods.Adaptive("Radau", rtol=1e-10, atol=1e-15))
    level = cf.mass_on_car(run.t, 0.0, 1.0)
    assert relative(run["s"], level["s"]) < 10 * alpha**2
    assert relative(run["force"], level["force"]) < 200 * alpha**2 + 5e-11 / alpha**2  # s weighs k/sin²α


@pytest.mark.parametrize("alpha", [0.1, np.pi / 2 - 1e-8, np.pi / 2])
def test_a_guide_of_any_inclination(alpha, slider):
    model = slider.with_parameters(alpha=alpha)
    assert model.free == 2
    run = sv.simulate(
        model, model.start(s=0.0, ds=0.0), (0.0, 3.0), method=sv.methods.Adaptive("Radau", rtol=1e-10, atol=1e-13)
    )
    reference = cf.mass_on_car(run.t, alpha, 1.0)
    assert np.abs(run["s"] - reference["s"]).max() < 1e-9
    assert relative(run["force"], reference["force"]) < 1e-7


BARRIERS = {  # of height 1 and width 1 about 0
    "Gauss": lambda s: ca.exp(-(s**2)),
    "soliton": lambda s: 1 / ca.cosh(s) ** 2,
    "plateau": lambda s: ca.exp(-(s**4)),
}


@pytest.mark.parametrize(
    ("name", "width", "method"),
    [*((name, 1e-3, None) for name in BARRIERS), ("Gauss", 1e-2, "DOP853"), ("plateau", 1e-2, "RadauIIA")],
)
def test_a_narrow_barrier_reflects(name, width, method):
    """A mass of energy 1/2 before a barrier of 1 returns, though its force is zero on its top."""
    q = sv.coordinates("x y")
    x, y = q
    potential = BARRIERS[name]((x - 1.0) / width)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=potential)
    model = sv.derive(mechanism, sv.Program({"rail": y}, by="ideal"))
    for place in (0.0, 0.1234):
        run = sv.simulate(model, model.start(x=place, dx=1.0), (0.0, 3.0), method, t_eval=[0.0, 3.0], max_step=width)
        assert run["dx"][-1] == pytest.approx(-1.0, abs=1e-7)
        assert run["x"][-1] == pytest.approx(place - 1.0 - 2 * place, abs=4 * width)
