"""C export: the files compile without a warning as C99, and compute what Python computes, to 1e-12."""

import contextlib
import ctypes
import re
import shlex
import subprocess
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from refusals import refused, warned

import servoctl as sv
from servoctl.codegen.compiler import compiler
from servoctl.codegen.function import compiled
from servoctl.errors import ServoError, SpecificationError
from servoctl.export.c import export_c
from servoctl.export.files import Array, Constant, Contents, Routine, Scalar, identifier, write
from servoctl.gallery import gallery

pytestmark = pytest.mark.usefixtures("c_compiler")

STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror")
TOLERANCE = 1e-12


class Exported:
    """The functions of a C file by name, called with numbers and arrays; what they return."""

    def __init__(self, files, name):
        source, header = files
        library = source.with_suffix(".so")
        command = [*shlex.split(compiler()), *STRICT, "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
        self.library, self.name, self.header = ctypes.CDLL(str(library)), name, header.read_text(encoding="utf-8")

    def __call__(self, function, *arguments):
        call = [
            a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray)
            else a if isinstance(a, ctypes.c_float) else ctypes.c_double(a) for a in arguments
        ]
        return self.library[f"{self.name}_{function}"](*call)

    def constant(self, name, size):
        return np.array((ctypes.c_double * size).in_dll(self.library, f"{self.name}_{name}"))

    def indices(self, key):
        found = re.findall(rf"^    {self.name.upper()}_{key.upper()}_(\w+) = (\d+)", self.header, re.M)
        return {name: int(index) for name, index in found}


@pytest.mark.parametrize("name", ["overhead-crane", "crane-3d-redundant", "three-cars"])
def test_feedforward_in_floats_is_that_of_doubles_to_six_digits(name, gallery_model, tmp_path):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(**scene.start, guess=scene.guess)
    times = np.linspace(*scene.t_span, 41)
    run = sv.simulate(model, start, scene.t_span, t_eval=times)
    plan, number = exported(model, tmp_path, start=start, real="float"), np.float32
    x, p = start.values.astype(number), model.parameters.astype(number)
    z, u = np.empty(len(model.jet_names), number), np.empty(len(model.actuators), number)
    wanted = np.array([run[actuator] for actuator in model.actuators])
    for k, t in enumerate(times):
        assert plan("feedforward", ctypes.c_float(t), x, p, z, u) >= 0
        assert np.abs(u - wanted[:, k]).max() < 2e-5 * np.abs(wanted).max()
    assert "double" not in re.sub(r"/\*.*?\*/", "", (tmp_path / "plan.c").read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("name", ["overhead-crane", "passive-arm"])
def test_a_time_that_is_no_number_is_refused(name, gallery_model, tmp_path):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(**scene.start, guess=scene.guess)
    plan, x = exported(model, tmp_path, start=start), start.values.copy()
    z, u = np.full(len(model.jet_names), 7.0), np.full(len(model.actuators), 7.0)
    for t in (np.nan, np.inf):
        assert plan("feedforward", t, x, model.parameters.copy(), z, u) == -1
        assert np.array_equal(x, start.values) and set(z) == {7.0} and set(u) == {7.0}


def exported(model, folder, **options):
    return Exported(export_c(model, folder, name="plan", **options), "plan")


def close(found, expected):
    scale = 1 + np.abs(expected).max(initial=0.0)
    return np.abs(np.asarray(found) - expected).max(initial=0.0) <= TOLERANCE * scale


@pytest.mark.parametrize("name", ["overhead-crane", "crane-3d-redundant", "three-cars"])
def test_feedforward_of_a_flat_program_is_the_run(name, gallery_model, tmp_path):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(**scene.start, guess=scene.guess)
    times = np.linspace(*scene.t_span, 101)
    run = sv.simulate(model, start, scene.t_span, t_eval=times)
    plan = exported(model, tmp_path, start=start)
    x, z, u = plan.constant("x0", len(start.values)), np.empty(len(model.jet_names)), np.empty(len(model.actuators))
    p = plan.constant("p", len(model.parameters))
    assert np.array_equal(x, start.values) and np.array_equal(p, model.parameters)
    for k, t in enumerate(times):
        assert plan("feedforward", t, x, p, z, u) >= 0
        assert close(z, run.jets[:, k]) and np.array_equal(x, z[: len(x)])
        assert close(u, np.array([run[actuator][k] for actuator in model.actuators]))


@pytest.mark.parametrize("name", ["vtol-centre", "passive-arm", "appell-hamel"])
def test_feedforward_of_internal_dynamics_is_the_runge_kutta_run(name, gallery_model, tmp_path):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(**scene.start, guess=scene.guess)
    steps, end = 50, 0.5
    with warned("unstable") if name == "vtol-centre" else contextlib.nullcontext():
        run = sv.simulate(model, start, (0.0, end), method=sv.methods.RungeKutta(4, step=end / steps))
    with warned("plan_advance", "hyperbolic", "15.04") if name == "vtol-centre" else contextlib.nullcontext():
        plan = exported(model, tmp_path, start=start)
    names, _ = model.signals("reaction" if model.reduction.ideal else "actuation")
    x, p = start.values.copy(), model.parameters
    z, u = np.empty(len(model.jet_names)), np.empty(len(names))
    assert len(run.t) == steps + 1
    for k, t in enumerate(run.t):
        plan("feedforward", t, x, p, z, u)
        assert close(z, run.jets[:, k]) and close(u, np.array([run[n][k] for n in names]))
        plan("advance", t, end / steps, x, p)


@pytest.mark.parametrize("name", ["overhead-crane-redundant", "two-cars-ideal", "constant-speed"])
def test_residuals_and_outputs_at_any_jets_and_parameters(name, gallery_model, tmp_path):
    model, random = gallery_model(name), np.random.default_rng(1)
    plan = exported(model, tmp_path)
    for t in random.uniform(0.2, 0.8, 5):
        z, p = random.uniform(0.3, 1.2, len(model.jet_names)), random.uniform(0.5, 2.0, len(model.parameters))
        for function, kind in (("residuals", "residuals"), ("outputs", "outputs")):
            names, f = model.signals(kind)
            y = np.full(len(names), np.nan)
            if names:
                plan(function, t, z, p, y)
                assert close(y, f(t, z, np.append(model.p[: -len(p)], p)))
    assert ("plan_outputs" in plan.header) == bool(model.outputs)
    assert "plan_x0" not in plan.header


def test_indices_have_the_names_of_the_model(gallery_model, tmp_path):
    model = gallery_model("overhead-crane")
    plan = exported(model, tmp_path)
    for key, names in {
        "p": model.reduction.mechanism.parameters.names,
        "x": model.state_names,
        "z": model.jet_names,
        "u": model.actuators,
        "y": model.outputs,
    }.items():
        assert plan.indices(key) == {name: i for i, name in enumerate(names)}
    assert "/* hidden: balance of theta */" in plan.header
    assert max(map(len, plan.header.splitlines())) <= 120


def test_feedforward_without_a_solution_says_so_and_changes_no_output(gallery_model, tmp_path):
    model = gallery_model("overhead-crane")
    plan = exported(model, tmp_path)
    z, u = np.full(len(model.jet_names), 7.0), np.full(2, 7.0)
    assert plan("feedforward", 1.0, np.full(len(model.state_names), np.nan), model.parameters, z, u) == -1
    assert set(z) == set(u) == {7.0}


def test_files_are_the_same_each_time(gallery_model, tmp_path):
    first = [f.read_text(encoding="utf-8") for f in export_c(gallery_model("vtol"), tmp_path / "a", name="vtol")]
    assert first == [f.read_text(encoding="utf-8") for f in export_c(gallery_model("vtol"), tmp_path / "b", name="vtol")]


def test_the_program_of_the_docs_prints_what_python_computes(gallery_model, tmp_path):
    model = gallery_model("overhead-crane").with_parameters(m_load=115.0)
    times = 0.1 * np.arange(81)
    run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0), t_eval=times)
    source, _ = export_c(gallery_model("overhead-crane"), tmp_path, name="crane", start=model.start(guess={"l": 4.0}))
    text = (Path(__file__).parents[1] / "docs" / "c_export.md").read_text(encoding="utf-8")
    (tmp_path / "main.c").write_text(re.search(r"```c\n(.*?)```", text, re.S)[1], encoding="utf-8")
    program = tmp_path / "program"
    command = [*shlex.split(compiler()), *STRICT, str(tmp_path / "main.c"), str(source), "-o", str(program), "-lm"]
    subprocess.run(command, check=True, capture_output=True)
    printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    found = np.array([line.split() for line in printed.splitlines()], dtype=float).T
    for values, name in zip(found, ("theta", "trolley", "hoist"), strict=True):
        assert close(values, run[name])


# laws ----------------------------------------------------------------------------------------------------------------


def law(memory=2, samples=5):
    """u = u_ff - K (y - y_ref) - sum z, z+ = z + (y - y_ref)/rate: what a row of the table gives is random."""
    t, x, p = ca.SX.sym("t"), ca.SX.sym("x", 2 + memory), ca.SX.sym("row", 5)
    error = x[:2] - p[1:3]
    u = p[0] - ca.dot(p[3:5], error) - ca.sum1(x[2:]) + ca.sin(t)
    following = x[2:] + error[:memory] / 100.0
    f = ca.Function("law", [t, x, p], [ca.densify(ca.vertcat(u, following, ca.sumsqr(error)))])
    table = np.random.default_rng(3).normal(size=(5, samples))
    facts = {"measures": ("x", "dx"), "inputs": ("push",), "rate": 100.0, "t0": 0.5, "state": np.full(memory, 0.25)}
    facts["state_names"] = ("integral of x", "integral of dx")[:memory]
    return SimpleNamespace(step=compiled(f, "law"), schedule=table, **facts)


@pytest.mark.parametrize("memory", [0, 2])
def test_a_law_steps_as_in_python(memory, tmp_path):
    given = law(memory)
    ours = Exported(export_c(given, tmp_path, name="loop"), "loop")
    z, u, expected = np.full(max(memory, 1), np.nan), np.empty(1), given.state
    ours("start", z)
    assert np.array_equal(z[:memory], given.state)
    random = np.random.default_rng(4)
    for k in range(-1, 9):
        t, y = 0.5 + k / 100, random.normal(size=2)
        row = given.schedule[:, min(max(k, 0), 4)]
        wanted = given.step(t, np.append(y, expected), row)
        ours("step", t, y, z, u)
        assert close(u, wanted[:1]) and close(z[:memory], wanted[1 : 1 + memory])
        expected = wanted[1 : 1 + memory]
    assert ours.indices("y") == {"x": 0, "dx": 1} and ours.indices("u") == {"push": 0}
    assert list(ours.indices("z")) == ["integral_of_x", "integral_of_dx"][:memory]


def test_an_lqr_with_integral_steps_as_its_controller(gallery_model, tmp_path):
    model = gallery_model("overhead-crane")
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))
    designed = sv.lqr(plan, sv.plant(model.reduction.mechanism), rate=50.0, integral=True)
    ours, controller = Exported(export_c(designed, tmp_path, name="loop"), "loop"), designed.start()
    z, u, random = np.empty(len(designed.state)), np.empty(2), np.random.default_rng(5)
    ours("start", z)
    for k in range(0, 450, 3):
        t = k / 50.0
        y = plan.state(min(t, 8.0)) + random.normal(scale=0.01, size=6)
        ours("step", t, y, z, u)
        assert close(u, controller(t, y)) and close(z, controller.state)
    assert list(ours.indices("y")) == list(designed.measures)


# names and errors ----------------------------------------------------------------------------------------------------


def test_names_that_are_no_identifiers_stay_apart_and_end_no_comment(tmp_path):
    t, x, p = ca.SX.sym("t"), ca.SX.sym("x", 4), ca.SX.sym("p", 0)
    f = ca.Function("f", [t, x, p], [ca.densify(ca.erfinv(x / 8) + ca.sign(x))])
    names = ("a b", "a_b", "θ */ int x; /*", "@")
    array, no = Array("x", "Any", names), Array("p", "None", ())
    routine = Routine("f", "Any.", (Scalar("t"), array.input(), no.input(), array.output("y")))
    files = write(tmp_path, "any", Contents([array, no], [Constant("half", 0.5, "A half")], {"f": f}, [routine]))
    ours = Exported(files, "any")
    values, y = np.array([-3.0, 0.5, 3.0, 0.0]), np.empty(4)
    ours("f", 0.0, values, np.empty(0), y)
    assert close(y, np.array(f(0, values, [])).ravel())
    assert ours.indices("x") == {"a_b": 0, "a_b_1": 1, "theta_int_x": 2, "_": 3}
    assert ours.constant("half", 1) == 0.5


@pytest.mark.parametrize(("name", "word"), [("dθ/dt", "dtheta_dt"), ("hidden: X", "hidden_X"), ("2x", "_2x")])
def test_identifiers_read_like_names(name, word):
    assert identifier(name) == word


@pytest.mark.parametrize("name", ["int", "2cranes", "over head", "", "kränchen", 5])
def test_a_name_that_c_does_not_take_is_refused(name, gallery_model, tmp_path):
    with refused(SpecificationError, name=name) as caught:
        export_c(gallery_model("two-cars"), tmp_path, name=name)
    assert caught.value.details["name"] == name
    assert not list(tmp_path.iterdir())


def test_what_has_no_expressions_is_refused(tmp_path):
    with refused(SpecificationError, "function", "Model", "Law"):
        export_c(lambda t, y: 0.0, tmp_path)


def test_a_start_is_one_of_the_model(gallery_model, tmp_path):
    with refused(SpecificationError, "float", "start"):
        export_c(gallery_model("two-cars"), tmp_path, start=0.0)


def test_a_start_for_a_law_is_refused(gallery_model, tmp_path):
    start = gallery_model("two-cars").start()
    with refused(SpecificationError, "start", "law"):
        export_c(law(), tmp_path, start=start)


def test_a_folder_that_is_a_file_is_refused(gallery_model, tmp_path):
    (tmp_path / "taken").write_text("", encoding="utf-8")
    with refused(ServoError, path=str(tmp_path / "taken")):
        export_c(gallery_model("two-cars"), tmp_path / "taken")


def test_marks_that_turn_or_hide_what_follows_reach_no_file(tmp_path):
    t, x, p = ca.SX.sym("t"), ca.SX.sym("x", 1), ca.SX.sym("p", 0)
    odd = "a\u202eb\u200b\u2028c\ud800\0d"
    array, no = Array("x", f"Any {odd}", (odd,)), Array("p", "None", ())
    routine = Routine("f", f"Any {odd}.", (Scalar("t"), array.input(), no.input(), array.output("y")))
    contents = Contents([array, no], [Constant("half", 0.5, odd)], {"f": ca.Function("f", [t, x, p], [2 * x])}, [routine])
    for file in write(tmp_path, "any", contents):
        assert all(letter.isprintable() or letter == "\n" for letter in Path(file).read_text(encoding="utf-8"))
