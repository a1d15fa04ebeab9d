"""Parameters from measured runs: statistics over seeds, logs, what cannot be seen, and what is refused."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.gallery import gallery
from servoctl.sensitivities.identification import _Problem
from servoctl.sensitivities.records import as_records

NOISE = {"x": 1e-3, "l": 1e-3, "theta": 1e-3, "dx": 5e-3, "dl": 5e-3, "dtheta": 5e-3}
TRUE = {"m_load": 112.0, "damping_x": 25.0}


@pytest.fixture(scope="module")
def crane(gallery_model):
    """A function from seed and noise to a measured run at 100 Hz of a crane that is not the planned one; its guess."""
    model = gallery_model("overhead-crane")
    mechanism = model.reduction.mechanism
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 1.5))
    law = sv.lqr(plan, sv.plant(mechanism), rate=100.0, integral=True)
    machine = sv.plant(mechanism, m_load=TRUE["m_load"], damping={"x": TRUE["damping_x"]})

    def run(seed, noise=NOISE):
        sensors = sv.Sensors(noise=noise, seed=seed) if noise else None
        return sv.close(machine, law, plan.state(0.0), (0.0, 1.5), sensors=sensors)

    return run, sv.plant(mechanism, damping={"x": 1.0})


def log(loop):
    return {"t": loop.t, **loop.input, **loop.measured}


def test_load_and_friction_of_the_crane_are_within_three_deviations_in_39_of_40_runs(crane):
    run, guess = crane
    deviations = []
    for seed in range(40):
        found = sv.identify(guess, run(seed), list(TRUE))
        assert found.success and not found.unseen
        deviations.append([(found[name] - value) / found.deviation(name) for name, value in TRUE.items()])
    within = (np.abs(deviations) < 3.0).all(axis=1)
    assert within.sum() >= 39
    assert 0.8 < np.std(deviations) < 1.25  # neither too cautious nor too sure


def test_without_noise_the_numbers_are_exact(crane):
    run, guess = crane
    found = sv.identify(guess, run(0, None), {"m_load": 80.0, "damping_x": 5.0}, noise=NOISE)
    assert [found[name] for name in TRUE] == pytest.approx(list(TRUE.values()), rel=1e-7)
    assert found.plant.damping["x"] == found["damping_x"] and found.misfit < 1e-5
    assert found.plant.rates(0.0, [0, 4.0, 0.1, 1.0, 0, 0], [0.0, -1000.0]) == pytest.approx(
        sv.plant(guess.mechanism, m_load=112.0, damping={"x": 25.0}).rates(0.0, [0, 4.0, 0.1, 1.0, 0, 0], [0.0, -1000.0])
    )


def test_the_jacobian_is_that_of_the_residuals(crane):
    run, guess = crane
    for count in (1, 4):
        problem = _Problem(guess, tuple(TRUE), *as_records(guess, run(1), None, None), count)
        x = problem.first(np.array([105.0, 20.0])) if count == 4 else problem.first(np.array([112.0, 25.0]))
        J = problem.jacobian(x)
        for j in (0, 1, 2, 4, 7):
            h = np.zeros(len(x))
            h[j] = 1e-5 * max(abs(x[j]), 1.0)
            difference = (problem.residuals(x + h) - problem.residuals(x - h)) / (2 * h[j])
            assert np.abs(difference - J[:, j]).max() < 1e-6 * np.abs(J[:, j]).max()


def test_a_log_of_positions_alone_and_several_runs(crane):
    run, guess = crane
    logs = [{name: values for name, values in log(run(seed)).items() if not name.startswith("d")} for seed in (3, 4)]
    noise = {"x": 1e-3, "theta": 1e-3, "l": 1e-3}
    one = sv.identify(guess, logs[0], list(TRUE), noise=noise)
    two = sv.identify(guess, logs, list(TRUE), noise=noise)
    for found in (one, two):
        assert all(abs(found[name] - value) < 4 * found.deviation(name) for name, value in TRUE.items())
        assert found.misfit == pytest.approx(1.0, abs=0.1)
    assert two.deviation("m_load") == pytest.approx(one.deviation("m_load") / np.sqrt(2), rel=0.1)
    assert len(two.starts) == 2 and set(two.residuals[1]) == {"x", "theta", "l"}


def test_measured_outputs(crane):
    run, guess = crane
    loop = run(5, None)
    rng = np.random.default_rng(1)
    data = log(loop) | {"X": loop["X"] + 1e-3 * rng.standard_normal(len(loop.t))}
    found = sv.identify(guess, data, list(TRUE), noise={"X": 1e-3, "l": 1e-3})
    assert all(abs(found[name] - value) < 4 * found.deviation(name) for name, value in TRUE.items())


def masses():
    """Two masses that move together: only their sum acts."""
    p = sv.parameters(m1=2.0, m2=3.0, c=1.0, unused=4.0)
    q = sv.coordinates("x")
    (x,) = q
    forces = {"x": -p.c * q.d(1)[0]}
    S = sv.particle(q, p.m1, x) + sv.particle(q, p.m2, x)
    outputs = {"weighed": p.unused * x}
    return sv.plant(sv.Mechanism(q, gibbs=S, forces=forces, actuators={"F": x}, parameters=p, outputs=outputs))


def shaken(plant, **numbers):
    """A log of a plant with these numbers under a force, with noise."""
    t = np.arange(0.0, 5.0, 0.01)
    path = sv.plant(plant.mechanism, **numbers)
    law = lambda t, y: {"F": 10.0 * np.sin(3 * t)}  # noqa: E731
    loop = sv.close(path, law, [0.0, 0.0], (0.0, t[-1] + 0.01), timing=sv.Timing(rate=100.0),
                    sensors=sv.Sensors(noise={"x": 1e-4}, seed=2))  # fmt: skip
    return {"t": loop.t, "F": loop.input["F"], "x": loop.measured["x"]}


def test_what_cannot_be_seen_is_named():
    plant = masses()
    data = shaken(plant, m1=2.5)
    found = sv.identify(plant, data, ["m1", "m2", "c"], noise={"x": 1e-4})
    assert found["m1"] + found["m2"] == pytest.approx(5.5, abs=0.01)
    assert found["c"] == pytest.approx(1.0, abs=0.01) and np.isfinite(found.deviation("c"))
    (direction,) = found.unseen
    assert set(direction) == {"m1", "m2"} and direction["m1"] * direction["m2"] < 0
    assert np.isinf(found.deviation("m1")) and "not seen" in repr(found) and "m2" in repr(found)
    lonely = sv.identify(plant, data, ["m1", "unused"], noise={"x": 1e-4})
    assert [set(direction) for direction in lonely.unseen] == [{"unused"}]
    assert lonely["unused"] == pytest.approx(4.0) and lonely["m1"] == pytest.approx(2.5, abs=0.01)


def test_wrong_noise_levels_are_said():
    plant = masses()
    found = sv.identify(plant, shaken(plant), ["m1", "c"], noise={"x": 2e-5})
    assert found.misfit == pytest.approx(5.0, rel=0.1) and "noise levels are wrong" in found.message


def test_masses_stay_positive():
    """A mass that begins negative is refused; one that begins far too large or small does not turn negative."""
    plant = masses()
    data = shaken(plant)
    for first in ({"m1": -10.0}, {"m1": -3.0}, {"m1": 1.0, "m2": -1.5}):  # of the sum, the inertia
        with refused(SpecificationError, "mass matrix"):
            sv.identify(plant, data, first, noise={"x": 1e-4})
    for first in (-2.9, 0.05, 300.0):  # m1 alone may be negative where the sum is not
        found = sv.identify(plant, data, {"m1": first, "c": 3.0}, noise={"x": 1e-4})
        assert abs(found["m1"] - 2.0) < 4 * found.deviation("m1") < 0.1, first
    against = data | {"F": -data["F"]}  # which no positive mass fits
    found = sv.identify(plant, against, {"m1": 1.0}, noise={"x": 1e-4})
    assert found["m1"] > -3.0 and "noise levels are wrong" in found.message


def test_lags_stay_positive():
    q = sv.coordinates("x")
    (x,) = q
    plant = sv.plant(sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), actuators={"F": x}), lag={"F": 0.1})
    t = np.arange(0.0, 4.0, 0.01)
    data = {"t": t, "F": np.sin(3 * t), "x": (t / 3 - np.sin(3 * t) / 9) / 2}  # without any lag
    with refused(SpecificationError, name="lag_F", value=-0.1):
        sv.identify(plant, data, {"lag_F": -0.1}, noise={"x": 1e-4})
    found = sv.identify(plant, data, {"lag_F": 0.02}, noise={"x": 1e-4})
    assert found["lag_F"] > 0 and found["lag_F"] < 0.02


def pendulum(**numbers):
    p = sv.parameters(m=1.0, l=0.5, g=9.81, c=0.05)
    (a,) = q = sv.coordinates("a")
    inertia, torque = p.m * p.l**2, -p.m * p.g * p.l * ca.sin(a) - p.c * q.d(1)[0]
    mechanism = sv.Mechanism(q, sv.particle(q, inertia, a), actuators={"M": a}, forces={"a": torque}, parameters=p)
    return sv.plant(mechanism, **numbers)


def test_times_in_milliseconds_are_refused():
    plant = pendulum()
    for period in (10.0, 2.0, 1.13):  # 4.43 1/s
        t = period * np.arange(300)
        with refused(SpecificationError, period=pytest.approx(period), eigenvalue=pytest.approx(4.43, abs=0.01)):
            sv.identify(plant, {"t": t, "M": np.ones(300), "a": 0.1 * np.sin(t)}, ["m"], noise={"a": 1e-3})
    lagging = pendulum(lag={"M": 0.005})  # four time constants per sample
    law = lambda t, y: {"M": 2.0 * np.sin(3 * t)}  # noqa: E731
    loop = sv.close(lagging, law, [0.0] * 3, (0.0, 4.0), timing=sv.Timing(rate=50.0))
    data = {"t": loop.t, "M": loop.input["M"], "a": loop.measured["a"]}
    found = sv.identify(lagging, data, {"m": 1.3}, noise={"a": 1e-4})
    assert found["m"] == pytest.approx(1.0, rel=1e-6)


def test_a_result_in_pieces_says_so():
    """A pendulum of another law in chaotic motion: neither the whole run nor the noise is explained."""
    plant = pendulum()
    law = lambda t, y: {"M": 6.0 * np.sin(3.1 * t)}  # noqa: E731
    loop = sv.close(pendulum(m=1.1), law, [0.5, 0.0], (0.0, 60.0), timing=sv.Timing(rate=50.0))
    a = loop.measured["a"] + 0.05 * np.sin(0.7 * loop.t)
    runs = [{"t": loop.t, "M": loop.input["M"], "a": a}, {"t": loop.t[:400], "M": loop.input["M"][:400], "a": a[:400]}]
    found = sv.identify(plant, runs, ["m", "c"], noise={"a": 1e-4})
    assert found.misfit > 1.25 and "pieces" in found.message and "noise levels are wrong" in found.message
    assert len(found.starts) == 2 and all(x.shape == (2,) for x in found.starts)
    assert [len(run["a"]) for run in found.residuals] == [len(loop.t), 400]


def test_what_an_identification_prints(crane):
    run, guess = crane
    found = sv.identify(guess, run(7), ["m_load"])
    assert "1 parameter from" in repr(found)
    longest = replace(found, message="converged " + "and ".join(["nothing is left out "] * 12))
    assert longest.message.split() == repr(longest).split()[6 : 6 + len(longest.message.split())]
    assert max(map(len, repr(longest).splitlines())) <= 118


def test_a_lag_is_found():
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 2.0, x), actuators={"F": x})
    true, guess = (sv.plant(mechanism, lag={"F": lag}) for lag in (0.2, 0.05))
    law = lambda t, y: {"F": 10.0 * np.sin(3 * t)}  # noqa: E731
    loop = sv.close(true, law, [0.0, 0.0], (0.0, 4.0), timing=sv.Timing(rate=100.0),
                    sensors=sv.Sensors(noise={"x": 1e-4}, seed=1))  # fmt: skip
    found = sv.identify(guess, loop, ["lag_F"])
    assert abs(found["lag_F"] - 0.2) < 4 * found.deviation("lag_F") < 0.01
    assert found.plant.lag["F"] == found["lag_F"]


@pytest.mark.parametrize(
    "change, kind, details",
    [
        ({"xx": 0.0}, NameUnknown, {"name": "xx"}),
        ({"F": None}, SpecificationError, {"missing": ["F"]}),
        ({"x": "short"}, SpecificationError, {"name": "x", "values": 250}),
        ({"x": "nan"}, SpecificationError, {"name": "x", "lost": 3, "sample": 40}),
        ({"t": "gap"}, SpecificationError, {"count": 1, "sample": 100}),
        ({"t": "uneven"}, SpecificationError, {"count": 2, "sample": 70}),
        ({"t": "back"}, SpecificationError, {"count": 1, "sample": 90}),
        ({"t": "nan"}, SpecificationError, {"count": 3, "sample": 40}),
    ],
    ids=lambda value: str(value)[:20],
)
def test_measurements_that_are_refused(change, kind, details):
    plant = masses()
    data = dict(shaken(plant))
    for name, how in change.items():
        if how is None:
            del data[name]
        elif how == "short":
            data[name] = data[name][::2][:250]
        elif how == "nan":
            data[name] = data[name].copy()
            data[name][[40, 41, 90]] = np.nan
        elif how == "gap":
            data[name] = data[name] + 0.5 * (np.arange(len(data[name])) >= 100)
        elif how == "uneven":
            data[name] = data[name] + 0.004 * (np.arange(len(data[name])) == 70)
        elif how == "back":
            data[name] = data[name] - 0.03 * (np.arange(len(data[name])) >= 90)
        else:
            data[name] = np.zeros(len(data["t"]))
    with refused(kind, **details):
        sv.identify(plant, data, ["m1"], noise={"x": 1e-4})


def test_other_arguments_that_are_refused(crane):
    run, guess = crane
    with refused(NameUnknown, "m_lode"):
        sv.identify(guess, run(0), ["m_lode"])
    with refused(NameUnknown, "damping_theta"):
        sv.identify(guess, run(0), ["damping_theta"])
    with refused(SpecificationError):
        sv.identify(guess, run(0), [])
    with refused(SpecificationError, 'noise={"x": 1e-3}'):
        sv.identify(guess, run(0, None), ["m_load"])  # without noise levels
    with refused(SpecificationError, 'noise={"a": 1e-3}'):
        sv.identify(pendulum(), {"t": np.arange(9.0), "M": np.ones(9), "a": np.ones(9)}, ["m"])
    with refused(NameUnknown, "phi"):
        sv.identify(guess, run(0), ["m_load"], noise={"phi": 1e-3})
    with refused(SpecificationError):
        sv.identify(guess, 3.0, ["m_load"])
    with refused(SpecificationError):
        sv.identify(masses(), run(0), ["m1"])
    redundant, _ = gallery["overhead-crane-redundant"].build()
    with refused(SpecificationError, "rope"):
        sv.identify(sv.plant(redundant), run(0), ["m_load"])
