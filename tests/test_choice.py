"""Methods and treatments of drift as values: short forms, checks at construction, which of them go together."""

import inspect
import pickle

import numpy as np
import pytest

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods import choice
from servoctl.methods.choice import METHODS, as_method

TREATMENTS = (None, sv.methods.Project(), sv.methods.Poles(0.1))
SETTINGS = {"rtol": 1e-4, "atol": 1e-6, "step": 0.02}


@pytest.fixture(scope="module")
def scene(gallery_model):
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    return model, model.start(guess=scene.guess, **scene.start), (0.0, 0.1)


@pytest.mark.parametrize(
    "value", [*METHODS.values(), *TREATMENTS[1:], sv.methods.Poles({"string": [-1 + 2j, -1 - 2j]})], ids=str
)
def test_values_are_equal_after_pickling_and_are_frozen(value):
    assert pickle.loads(pickle.dumps(value)) == value
    assert eval(repr(value), vars(sv.methods)) == value
    with pytest.raises(AttributeError):
        value.rtol = 1e-3


@pytest.mark.parametrize("name", METHODS)
def test_a_short_form_is_the_value_with_its_defaults(name):
    assert str(METHODS[name]) == name and as_method(name) == as_method(METHODS[name]) == METHODS[name]


@pytest.mark.parametrize("drift", TREATMENTS, ids=str)
@pytest.mark.parametrize("name", [name for name in METHODS if name != "bounded"])
def test_a_combination_runs_or_is_refused_and_the_run_keeps_its_words(name, drift, scene):
    model, start, span = scene
    settings = {key: value for key, value in SETTINGS.items() if hasattr(METHODS[name], key) and name != "RadauIIA"}
    method = as_method(name, **settings)
    if name == "algebraic" or type(drift) in method.refused:
        with pytest.raises(sv.errors.SpecificationError) as caught:
            sv.simulate(model, start, span, method, drift=drift)
        for other in caught.value.details.get("methods", ()):
            assert type(drift) not in METHODS[other].refused
    else:
        run = sv.simulate(model, start, span, method, drift=drift)
        assert run.success and (run.method, run.drift) == (name, str(drift or ""))


def test_a_short_form_and_its_value_give_the_same_run(scene):
    for short, value in (
        ("Taylor", sv.methods.Taylor()),
        ("RK8", sv.methods.RungeKutta()),
        ("DOP853", sv.methods.Adaptive()),
        (None, sv.methods.Taylor()),
    ):
        one, other = (sv.simulate(*scene, method, drift="project") for method in (short, value))
        assert np.array_equal(one.jets, other.jets)


@pytest.mark.parametrize(
    ("make", "details"),
    [
        (lambda: sv.methods.RungeKutta(3), {"order": 3}),
        (lambda: sv.methods.RungeKutta(4, step="x"), {"name": "step", "value": "x"}),
        (lambda: sv.methods.RadauIIA(order=3), {"order": 3}),
        (lambda: sv.methods.RadauIIA(step=0.0), {"name": "step", "value": 0.0}),
        (lambda: sv.methods.Taylor(order=1), {"order": 1}),
        (lambda: sv.methods.Taylor(jets=41), {"jets": 41}),
        (lambda: sv.methods.Taylor(rtol=-1), {"name": "rtol", "value": -1}),
        (lambda: sv.methods.Adaptive("LSODA", atol=True), {"name": "atol", "value": True}),
        (lambda: sv.methods.Adaptive("Radau", rtol=1e-15), {"rtol": 1e-15}),
        (lambda: as_method("RK4", rtol=1e-3), {"rtol": 1e-3}),
        (lambda: as_method("algebraic", step=1e-3), {"step": 1e-3}),
        (lambda: sv.methods.Project(0), {"every": 0}),
        (lambda: sv.methods.Poles(-0.1), {"name": "time constant", "value": -0.1}),
        (lambda: sv.methods.Poles({"x": [-1 + 1j]}), {"row": "x"}),
    ],
)
def test_what_makes_no_sense_cannot_be_made(make, details):
    with pytest.raises(sv.errors.SpecificationError) as caught:
        make()
    assert caught.value.details == details


@pytest.mark.parametrize(
    "make", [lambda: sv.methods.Adaptive("RK4"), lambda: as_method(["Taylor"])]
)
def test_names_belong_to_families(make):
    with pytest.raises(sv.errors.NameUnknown):
        make()


def test_the_nearest_order_is_computed():
    with pytest.raises(sv.errors.SpecificationError, match="order=8"):
        sv.methods.RungeKutta(7)
    with pytest.raises(sv.errors.SpecificationError, match="order=13"):
        sv.methods.RadauIIA(order=12)


@pytest.mark.parametrize("verb, most", [(sv.simulate, 12), (sv.tradeoff, 8)])
def test_verbs_have_few_parameters(verb, most):
    assert len(inspect.signature(verb).parameters) <= most


def test_jets_beside_an_accuracy_where_nothing_is_integrated(gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(), (0.0, 0.5), sv.methods.Taylor(jets=4), accuracy=1e-6, t_eval=[0.5])
    plain = sv.simulate(model, model.start(), (0.0, 0.5), t_eval=[0.5])
    assert run.method == "Taylor" and np.isfinite(run["d4theta"]).all()
    assert run.jets[: len(plain.jets)] == pytest.approx(plain.jets, rel=1e-9, abs=1e-9)


def test_the_default_is_a_series_where_nothing_speaks_against_it(scene, gallery_model, monkeypatch):
    model, start, span = scene
    assert sv.simulate(*scene).method == sv.simulate(*scene, drift="project").method == "Taylor"
    assert sv.simulate(*scene, drift=0.1).method == "DOP853"
    flat = gallery_model("overhead-crane")
    assert sv.simulate(flat, flat.start(), (0.0, 0.1)).method == "algebraic"
    monkeypatch.setattr(choice, "LARGE_FOR_SERIES", model.function("ode").operations - 1)
    assert sv.simulate(*scene).method == "DOP853"
