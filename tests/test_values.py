"""Values: models, plants, runs and laws are equal by what they say, travel to other processes, and never change."""

import copy
import inspect
import multiprocessing
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace

import casadi as ca
import conftest  # noqa: F401 - workers compile as tests do
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.gallery import gallery, overhead_crane
from servoctl.model.equations import signal_groups
from servoctl.model.variants import derived_near
from servoctl.values import frozen

SCENES = ("overhead-crane", "appell-hamel", "constant-speed", "wheeled-robot")


def again(value):
    """A value as another process gets it."""
    return pickle.loads(pickle.dumps(value))


@pytest.fixture(scope="module")
def crane():
    """The crane's mechanism, model, plan, plant with all that a plant may have, and a law."""
    scene = gallery["overhead-crane"]
    mechanism, program = scene.build()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span, progress=False)
    friction = {"theta": -3.0 * ca.tanh(mechanism.q.d(1)[2])}
    limits = {"trolley": 5000.0}
    plant = sv.plant(mechanism, m_load=115.0, damping={"x": 2.0}, lag={"hoist": 0.05}, limits=limits, forces=friction)
    return mechanism, model, plan, plant, sv.lqr(plan, sv.plant(mechanism), rate=100.0)


@pytest.mark.parametrize("name", SCENES)
def test_a_model_that_travelled_is_equal_and_computes_the_same_bits(name):
    scene = gallery[name]
    model = sv.derive(*scene.build())
    sent = again(model)
    assert sent == model and hash(sent) == hash(model) and repr(sent) == repr(model)
    assert sent.function("ode").source() == model.function("ode").source()
    start = model.start(**scene.start, guess=scene.guess)
    there = sent.start(**scene.start, guess=scene.guess)
    assert there == start and np.array_equal(there.values, start.values)
    span = (scene.t_span[0], scene.t_span[0] + 0.2)
    here, far = (sv.simulate(m, start, span, t_eval=np.linspace(*span, 5), progress=False) for m in (model, sent))
    assert far == here and again(here) == here
    group = next(iter(signal_groups(model.reduction)))
    assert np.array_equal(far[group], here[group]) and np.array_equal(again(here)[group], here[group])


def test_models_differ_by_what_they_say(crane):
    mechanism, model, plan, _, _ = crane
    jets = plan.jets[:, 3]
    others = [
        model.with_parameters(m_load=90.0),
        derived_near(model, plan.t[3], jets),
        sv.derive(*gallery["overhead-crane"].build(), guess={"l": 3.0}),
        sv.derive(*gallery["crane-3d"].build()),
    ]
    assert all(other != model and again(other) == other for other in others)
    assert sv.derive(*gallery["overhead-crane"].build()) == model == model.with_parameters()
    assert model != "a model"
    assert again(mechanism) == mechanism != gallery["crane-3d"].build()[0]


def test_a_model_that_travelled_takes_other_numbers_and_other_pivots(crane):
    _, model, plan, _, _ = crane
    t, jets = plan.t[5], plan.jets[:, 5]
    for change in (lambda m: m.with_parameters(m_load=50.0), lambda m: derived_near(m, t, jets)):
        here, far = change(model), change(again(model))
        assert here.numbers == far.numbers
        values = [m.signals("actuation")[1](t, jets, m.p) for m in (here, far)]
        assert values[0] == pytest.approx(values[1], rel=1e-12)  # by pivots that either chose


def test_a_plant_that_travelled_is_equal_and_computes_the_same_bits(crane):
    mechanism, _, _, plant, _ = crane
    sent = again(plant)
    assert sent == plant and hash(sent) == hash(plant) and repr(sent) == repr(plant)
    x, u, d = [0.1, 4.0, 0.1, 0.2, 0.3, 0.1, 20.0], [3.0, -900.0], [0.0, 1.0, 2.0]
    assert np.array_equal(sent.rates(0.2, x, u, d), plant.rates(0.2, x, u, d))
    without = sv.plant(mechanism, m_load=115.0, damping={"x": 2.0}, lag={"hoist": 0.05}, limits={"trolley": 5000.0})
    assert without != plant
    assert sv.plant(mechanism, m_load=115.0) != sv.plant(mechanism, m_load=116.0)


def test_plants_that_travelled_share_what_is_derived_of_them(crane):
    *_, plant, _ = crane
    content = pickle.dumps(plant)
    first, second = pickle.loads(content), pickle.loads(content)
    assert first.mechanism is second.mechanism and first.function("ode") is second.function("ode")


def test_runs_and_laws_that_travelled_are_equal(crane):
    mechanism, _, plan, _, law = crane
    sent = again(plan)
    assert sent == plan and hash(sent) == hash(plan) and sent != plan.t.size
    assert np.array_equal(sent["trolley"], plan["trolley"])
    assert all(np.array_equal(sent.residual[name], plan.residual[name]) for name in plan.residual)
    nominal = sv.plant(mechanism)
    noise = dict.fromkeys(mechanism.q.names, 1e-3)
    laws = [law, sv.feedforward(plan, nominal), sv.pd(plan, nominal), sv.lqr(plan, nominal, integral=True)]
    laws.append(sv.output_feedback(law, nominal, noise=noise))
    laws.append(sv.limited(law, sv.plant(mechanism, limits={"trolley": 2000.0, "hoist": 3000.0})))
    for value in laws:
        assert again(value) == value and hash(again(value)) == hash(value)
    assert len({repr(value) for value in laws}) == len(laws)
    assert all(value != other for i, value in enumerate(laws) for other in laws[:i])


def test_a_loaded_run_is_equal_by_its_signals(crane, tmp_path):
    _, _, plan, _, _ = crane
    loaded = sv.load(plan.save(tmp_path / "plan"))
    assert again(loaded) == loaded == sv.load(tmp_path / "plan.npz") != plan
    loaded.stored["trolley"][0] += 1.0
    assert loaded != sv.load(tmp_path / "plan.npz")


def test_loops_of_what_travelled_are_the_same_to_the_bit(crane):
    _, _, plan, _, law = crane
    plant = sv.plant(crane[0], m_load=115.0)
    here = sv.close(plant, law, plan.state(0.0), (0.0, 0.5))
    there = sv.close(*again((plant, law)), plan.state(0.0), (0.0, 0.5))
    assert np.array_equal(here.states, there.states) and np.array_equal(here.inputs, there.inputs)


def endpoint(model, start, t):
    """What a worker computes."""
    return sv.simulate(model, start, (0.0, t), progress=False)


def test_models_and_runs_go_to_spawned_processes_and_come_back(crane):
    _, model, plan, _, _ = crane
    start = model.start(guess={"l": 4.0})
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        back = pool.submit(endpoint, model, start, 0.5).result()
    here = endpoint(model, start, 0.5)
    assert back == here and back.model == model
    assert np.array_equal(back["trolley"], here["trolley"])


UNPICKLED = """
import pickle, sys
values = pickle.loads(sys.stdin.buffer.read())
sys.stdout.buffer.write(pickle.dumps(values))
"""


def test_values_survive_a_process_that_imported_nothing(crane):
    sent = subprocess.run([sys.executable, "-c", UNPICKLED], input=pickle.dumps(crane), capture_output=True, check=True)
    assert pickle.loads(sent.stdout) == crane


def test_a_model_prints_the_same_whatever_was_done_with_it():
    scene = gallery["overhead-crane"]
    model = sv.derive(*scene.build())
    before = repr(model)
    model.structure(), model.function("ode")
    run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 0.5), progress=False)
    assert run["trolley"].size and repr(model) == before == repr(sv.derive(*scene.build()))


def test_nothing_is_written_into_a_specification():
    mechanism, program = gallery["overhead-crane"].build()
    assert mechanism.mass.shape == (3, 3) and mechanism.energy.shape == (1, 1)  # derived once, when they are read
    before = {value: dict(vars(value)) for value in (mechanism, mechanism.parameters)} | {program: dict(vars(program))}
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 0.5), progress=False)
    sv.close(sv.plant(mechanism), sv.lqr(plan, sv.plant(mechanism)), plan.state(0.0), (0.0, 0.5))
    for value, attributes in before.items():
        assert list(vars(value)) == list(attributes)
        assert all(vars(value)[name] is attributes[name] for name in attributes)


def test_arrays_of_values_cannot_be_written(gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(), (0.0, 1.0), t_eval=[0.0, 0.5, 1.0])
    for value in (run, pickle.loads(pickle.dumps(run))):
        for array in (value.t, value.jets, value["x"], value.model.parameters):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 7.0


def test_parts_of_a_model_say_how_they_pickle(gallery_model):
    model = gallery_model("overhead-crane")
    for part in (model.reduction, model.reduction.program):
        with refused(sv.errors.SpecificationError, "sv.derive(mechanism, program)", type=type(part).__name__):
            pickle.dumps(part)
    other = pickle.loads(pickle.dumps(model))
    assert other == model and other.reduction.program == model.reduction.program


def test_programs_are_equal_by_names_choices_and_expressions():
    def program(name="A", symbol="x", factor=2.0, **choices):
        return sv.Program({name: factor * sv.coordinates(symbol)[symbol] - 1.0}, **choices)

    assert program() == program() and hash(program()) == hash(program())
    weighted = program(by="actuators", weights={"u": 2.0})
    others = [program("B"), program(symbol="y"), program(factor=3.0), program(by="actuators"), weighted]
    others += [program(by="actuators", weights={"u": 3.0}), program(by="actuators", toward={"u": 2.0})]
    assert all(a != b for i, a in enumerate([program(by="ideal"), *others]) for b in others[i:])
    assert program() != "A"


def test_a_copy_of_a_mechanism_has_its_symbols():
    """Also where an equal mechanism of other symbols came from another process before."""
    other, _ = overhead_crane()
    again(other)
    mechanism, _ = overhead_crane()
    assert [a.element_hash() for a in copy.copy(mechanism).q] == [a.element_hash() for a in mechanism.q]


class Fields:
    """Fields of every kind."""

    name: str
    size: float = 2.0
    items: list = field(default_factory=list)
    hidden: int = field(default=3, repr=False, compare=False)
    _kept: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self):
        self._kept["made"] = self.name


def made_by(decorator):
    return decorator(type("Value", (Fields,), dict(vars(Fields)) | {"__qualname__": "Value"}))


def test_frozen_values_are_what_frozen_dataclasses_are():
    ours, theirs = made_by(frozen), made_by(dataclass(frozen=True))
    assert str(inspect.signature(ours)) == str(inspect.signature(theirs))
    for cls in (ours, theirs):
        a, b = cls("a"), cls("a", hidden=4)
        assert repr(a) == "Value(name='a', size=2.0, items=[])"
        assert a == b and a != replace(a, size=3.0) and a != "a"
        assert a.items is not b.items and a._kept == {"made": "a"} and replace(a, name="c")._kept == {"made": "c"}
        assert cls.__match_args__ == ("name", "size", "items", "hidden")
        with pytest.raises(FrozenInstanceError):
            a.size = 1.0
        with pytest.raises(FrozenInstanceError):
            del a.size
        with pytest.raises(TypeError):
            cls()
        with pytest.raises(TypeError, match="unhashable"):
            hash(a)
        assert hash(replace(a, items=())) == hash(replace(b, items=()))


def test_a_plain_subclass_of_a_frozen_value_has_attributes_of_its_own():
    class Named(made_by(frozen)):
        def __init__(self, *values, label):
            super().__init__(*values)
            self.label = label

    value = Named("a", label="mine")
    assert value.label == "mine"
    del value.label
    for name in (f.name for f in fields(value)):
        with pytest.raises(FrozenInstanceError):
            setattr(value, name, 1.0)


def test_frozen_values_keep_what_their_class_defines():
    @frozen(eq=False)
    class Own:
        number: int

        def __repr__(self):
            return "own"

    assert repr(Own(1)) == "own" and Own(1) != Own(1)
