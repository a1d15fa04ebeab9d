"""A run by its names: as a mapping, in files, with its model again."""

from math import comb

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from test_continuation import arm, moved

import servoctl as sv
from servoctl.run import Run


@pytest.fixture(scope="module")
def run():
    return moved("spiral", np.linspace(0, 3, 301))


def test_a_run_goes_by_its_names_like_a_mapping(run):
    assert list(run) == list(run.keys()) == list(run.names) and len(run) == len(run.names)
    assert "a" in run and "u" in run and "q" not in run and 3 not in run
    values = dict(run)
    assert list(values) == list(run.names) and all(values[name] is run[name] for name in ("u", "energy"))


def test_a_closed_loop_goes_by_its_names(run):
    plant = sv.plant(run.model.reduction.mechanism)
    closed = sv.close(plant, sv.lqr(run, plant, rate=100), run.state(0.0), (0.0, 0.1), plan=run)
    assert list(closed) == list(closed.names) and "u" in closed and "w" not in closed
    assert dict(closed)["u"] == pytest.approx(closed["u"])


def test_a_run_is_loaded_with_its_model(run, tmp_path):
    assert len(run.variants) == 2  # of chosen pivots, then without a choice
    path = run.save(tmp_path / "plan")
    model = sv.derive(run.model.reduction.mechanism, run.model.reduction.program)  # derived again
    loaded = sv.load(tmp_path / "plan", model=model)
    assert loaded == run and loaded.start == run.start and path.suffix == ".npz"
    assert sv.verify(loaded).passed
    plant = sv.plant(model.reduction.mechanism)
    law, other = (sv.lqr(plan, plant, rate=100) for plan in (run, loaded))
    assert other.schedule == pytest.approx(law.schedule, rel=1e-9, abs=1e-9)  # a loaded plan has its samples alone
    assert sv.load(path).model is None and sv.load(path).start == run.start


def test_a_run_is_not_loaded_with_another_model(run, tmp_path, gallery_model):
    path = run.save(tmp_path / "plan.npz")
    with refused(sv.errors.SpecificationError, residuals=["X", "Y"]):
        sv.load(path, model=arm("circle")[0])
    with refused(sv.errors.SpecificationError, "parameters"):
        sv.load(path, model=gallery_model("overhead-crane"))
    with refused(sv.errors.SpecificationError, "str", name="model", type="str"):
        sv.load(path, model="spiral")


def test_a_run_of_other_parameters_is_refused(gallery_model, tmp_path):
    model = gallery_model("overhead-crane")
    name, value = next(iter(model.numbers.items()))
    run = sv.simulate(model, model.start(), (0.0, 1.0), t_eval=np.linspace(0, 1, 11))
    path, heavier = run.save(tmp_path / "crane"), model.with_parameters(**{name: 1.5 * value})
    with refused(sv.errors.SpecificationError, parameters={name: (value, 1.5 * value)}):
        sv.load(path, model=heavier)
    assert sv.load(path, model=heavier.with_parameters(**{name: value})) == run


def test_the_suffix_of_a_file_may_be_left_out(run, tmp_path):
    run.save(tmp_path / "plan.v2")
    assert sv.load(tmp_path / "plan.v2").message == sv.load(tmp_path / "plan.v2.npz").message == "finished"
    with refused(sv.errors.ServoError, "plan.v3"):
        sv.load(tmp_path / "plan.v3")


def test_signals_are_drawn_by_several_names(run):
    units = {"a": "rad", "b": "rad"}
    (ax,) = sv.figures.signals(run, "a", "b", units=units)
    assert len(ax.lines) == len(sv.figures.signals(run, ["a", "b"], units=units)[0].lines) == 2


# outputs of higher order than the motion ------------------------------------------------------------------------------


def driven_points():
    """A driven point on x, and one beside it on y that a damped spring of rate 3 and damping 0.8 holds."""
    q = sv.coordinates("x y")
    (x, y), (d3x, d3y) = q, q.d(3)
    outputs = {"jerk": d3x, "snap": q.dt(x * y, 4), "second jerk": d3y}
    return q, lambda **parts: sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, x) + sv.particle(q, 1.0, y), outputs=outputs, **parts
    )


def product(x, y, order):
    """The derivative of x y from those of both, by Leibniz' rule."""
    return sum(comb(order, k) * x[k] * y[order - k] for k in range(order + 1))


@pytest.mark.parametrize("samples", [7, 1001])
def test_outputs_of_any_order_along_a_flat_program(samples, tmp_path):
    """x = sin 2t, y = e^-t."""
    q, mechanism = driven_points()
    x, y = q
    program = sv.Program({"X": x - ca.sin(2 * q.t), "Y": y - ca.exp(-q.t)})
    model = sv.derive(mechanism(actuators={"a": x, "b": y}), program)
    run = sv.simulate(model, model.start(), (0.0, 3.0), t_eval=np.linspace(0.0, 3.0, samples))
    X = [2.0**k * np.sin(2 * run.t + k * np.pi / 2) for k in range(5)]
    Y = [(-1.0) ** k * np.exp(-run.t) for k in range(5)]
    expected = {"jerk": X[3], "snap": product(X, Y, 4), "second jerk": Y[3]}
    for name, values in expected.items():
        assert run[name] == pytest.approx(values, abs=1e-11)
    assert sv.verify(run).passed
    assert sv.load(run.save(tmp_path / "run.npz"))["snap"] == pytest.approx(expected["snap"], abs=1e-11)


@pytest.mark.parametrize("method", ["DOP853", "Taylor", "RK8"])
def test_outputs_of_any_order_along_an_integrated_motion(method):
    """y''' = -0.8 y'' - 3 y'."""
    q, mechanism = driven_points()
    x, y = q
    parts = {"actuators": {"a": x}, "forces": {"y": -0.8 * q.dt(y) - 3.0 * y}}
    model = sv.derive(mechanism(**parts), sv.Program({"X": x - ca.sin(2 * q.t)}))
    run = sv.simulate(model, model.start(y=0.3, dy=-0.1), (0.0, 3.0), method)
    assert run["second jerk"] == pytest.approx(-0.8 * run["d2y"] - 3.0 * run["dy"], abs=1e-10)
    Y = [run["y"], run["dy"], run["d2y"], run["second jerk"], -0.8 * run["second jerk"] - 3.0 * run["d2y"]]
    X = [2.0**k * np.sin(2 * run.t + k * np.pi / 2) for k in range(5)]
    assert run["snap"] == pytest.approx(product(X, Y, 4), abs=1e-5)


def test_files_and_systems_refuse_outputs_beyond_the_jets(tmp_path):
    q, mechanism = driven_points()
    x, y = q
    model = sv.derive(mechanism(actuators={"a": x, "b": y}), sv.Program({"X": x - ca.sin(q.t), "Y": y}))
    with refused(sv.errors.SpecificationError, "jerk", name="jerk", order=3, limit=2):
        sv.export_c(model, tmp_path)


def test_a_mechanism_without_outputs_has_an_empty_group_of_them():
    q = sv.coordinates("x")
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, *q), actuators={"u": q.jet(0)})
    model = sv.derive(mechanism, sv.Program({"X": q.jet(0) - q.t}))
    names, f = model.signals("outputs")
    assert names == [] and f(0.0, np.zeros(f.n_x), []).size == 0


@pytest.mark.parametrize("direction", [1, -1])
def test_no_polynomial_of_an_extremum_crosses_a_knot_forwards_or_backwards(direction):
    t = np.linspace(0.0, 2.0, 41)[::direction]
    run = Run(t, np.abs(t - 1.52)[None], ("x",), knots=(0.5, 1.52))
    (at, least), _ = run.extrema("x")
    assert (at, least) == (pytest.approx(1.5), pytest.approx(0.02, rel=1e-12))
