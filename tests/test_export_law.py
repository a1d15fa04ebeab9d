"""Laws as C: each kind compiled without a warning and run in a loop of its own against Python, to 1e-12."""

import ctypes
import re
import shlex
import subprocess
from pathlib import Path
from shutil import which

import numpy as np
import pytest
from refusals import refused
from scenes import CRANE
from scipy.interpolate import CubicHermiteSpline
from test_robot_programs import HOME, arm_plan

import servoctl as sv
from servoctl.codegen.compiler import compiler
from servoctl.errors import SpecificationError
from servoctl.export.c import thin

pytestmark = pytest.mark.usefixtures("c_compiler")

STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror")
SENSORS = {"x": 1e-3, "l": 1e-3, "theta": 1e-3}

LAWS = {
    "feedforward": lambda plan, plant: sv.feedforward(plan, plant),
    "pd": lambda plan, plant: sv.pd(
        plan, plant, kp={"trolley": 500.0, "hoist": 900.0}, kd={"trolley": 300.0, "hoist": 300.0}
    ),
    "lqr": lambda plan, plant: sv.lqr(plan, plant),
    "lqr with integral": lambda plan, plant: sv.lqr(plan, plant, integral=True),
    "frozen-time lqr": lambda plan, plant: sv.lqr(plan, plant, varying=False),
    "computed": lambda plan, plant: sv.computed(plan, plant),
    "output feedback": lambda plan, plant: sv.output_feedback(sv.lqr(plan, plant), plant, SENSORS),
    "output feedback with integral": lambda plan, plant: sv.output_feedback(
        sv.lqr(plan, plant, integral={"X": 1e4}), plant, SENSORS
    ),
    "lqr that holds the trolley": lambda plan, plant: sv.lqr(plan, plant, integral={"x": 1e4, "Z": 1e4}),
    "limited": lambda plan, _: narrow(plan),
    "limited by priority": lambda plan, _: narrow(plan, priority=["Z", "X"]),
    "limited output feedback": lambda plan, plant: sv.limited(
        sv.output_feedback(sv.lqr(plan, plant, integral=True), plant, SENSORS),
        sv.plant(CRANE, limits={"trolley": 120.0}),
    ),
    "lqr of a lagged plant": lambda plan, _: sv.lqr(plan, sv.plant(CRANE, lag={"trolley": 0.05})),
}
MEMORY = {
    "lqr with integral": 2, "lqr that holds the trolley": 2, "computed": 2, "output feedback": 6, "output feedback with integral": 7,
    "limited": 4, "limited by priority": 4, "limited output feedback": 10,
}  # fmt: skip


def test_laws_without_expressions_name_themselves_and_what_can_be_exported(plan, tmp_path):
    inside = sv.lqr(plan, sv.plant(CRANE))
    own = sv.Law("held", (), ("trolley", "hoist"), 100.0, 0.0, lambda t, x, row: row, np.zeros((2, 1)))
    with refused(SpecificationError, "Python", law="held"):
        sv.export_c(own, tmp_path)
    with refused(SpecificationError, "Model", "Law", type="dict"):
        sv.export_c({}, tmp_path)
    for folder in (None, 3):
        with refused(SpecificationError, path=folder):
            sv.export_c(inside, folder)
    with refused(SpecificationError, "start", type="int"):
        sv.export_c(plan.model, tmp_path, start=3)


def library(law, folder):
    source, header = sv.export_c(law, folder, name="loop")
    shared = source.with_suffix(".so")
    command = [*shlex.split(compiler()), *STRICT, "-fPIC", "-shared", str(source), "-o", str(shared), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    return ctypes.CDLL(str(shared)), header.read_text(encoding="utf-8")


class InC:
    """An exported law as the user's own law of `close`: started anew by `start`."""

    def __init__(self, law, folder):
        self.law, (self.c, self.header) = law, library(law, folder)

    def start(self):
        z, u = np.full(max(len(self.law.state), 1), np.nan), np.empty(len(self.law.inputs))
        self.c.loop_start(z.ctypes.data_as(ctypes.c_void_p))
        self.states = [z[: len(self.law.state)].copy()]

        def step(t, measurement):
            y = np.array([measurement[name] for name in self.law.measures] or [0.0])
            self.c.loop_step(ctypes.c_double(t), *(a.ctypes.data_as(ctypes.c_void_p) for a in (y, z, u)))
            self.states.append(z[: len(self.law.state)].copy())
            return u.copy()

        return step


def close_to(found, expected):
    return np.abs(found - expected).max(initial=0.0) <= 1e-12 * (1 + np.abs(expected).max(initial=0.0))


@pytest.mark.parametrize("name", LAWS)
def test_a_law_in_c_answers_what_it_answered_in_the_loop(name, plan, tmp_path):
    law = LAWS[name](plan, sv.plant(CRANE))
    machine = sv.plant(CRANE, m_load=115.0, lag={"trolley": 0.05} if "lagged" in name else None)
    span = (0.0, 4.0) if name in ("feedforward", "pd") else (0.0, 9.0)  # beyond the table, where its last row holds
    noise = {measure: 1e-3 for measure in law.measures}
    run = sv.close(machine, law, plan.state(0.0), span, sensors=sv.Sensors(noise))
    assert len(law.state) == MEMORY.get(name, 0)
    ours = InC(law, tmp_path)
    step = ours.start()
    measured = [dict(zip(law.measures, y, strict=True)) for y in run.measurements.T]
    commands = np.array([step(t, y) for t, y in zip(run.t, measured, strict=True)]).T
    assert close_to(commands, run.commands)
    assert close_to(np.array(ours.states[:-1]).T, run.controller_states)


@pytest.mark.parametrize("name", ["lqr with integral", "computed"])
def test_a_loop_closed_by_the_c_file_is_the_loop_of_the_law(name, plan, tmp_path):
    law = LAWS[name](plan, sv.plant(CRANE))
    given = (plan.state(0.0), (0.0, 4.0))
    run = sv.close(sv.plant(CRANE, m_load=110.0), law, *given)
    ours = sv.close(sv.plant(CRANE, m_load=110.0), InC(law, tmp_path), *given, timing=sv.Timing(rate=100.0), plan=plan)
    assert np.abs(ours.states - run.states).max() < 1e-10 and np.abs(run.states - plan.state(0.0)[:, None]).max() > 1


def test_the_table_is_a_constant_and_indices_have_names(plan, tmp_path):
    law = sv.lqr(plan, sv.plant(CRANE), integral=True)
    _, header = library(law, tmp_path)
    source = (tmp_path / "loop.c").read_text(encoding="utf-8")
    for name in law.measures:
        assert re.search(rf"LOOP_Y_{name} = {law.measures.index(name)}\b", header)
    assert "LOOP_Z_integral_of_X" in header and "LOOP_U_hoist" in header
    size = int(re.search(r"static const double \w*table\[(\d+)\]", source)[1])
    assert set(re.findall(r"#include (\S+)", source)) == {'"loop.h"', "<math.h>"}
    assert size == law.schedule.size and "malloc" not in source


def test_a_thinned_schedule_is_within_its_bound(plan):
    law = sv.lqr(plan, sv.plant(CRANE), rate=500.0, integral=True)
    rows = np.asarray(law.schedule).T
    sizes = {}
    for bound in (1e-3, 1e-5, 1e-7):
        knots, slopes = thin(rows, bound)
        sizes[bound] = len(knots)
        assert knots[0] == 0
        assert knots[-1] == len(rows) - 1
        cubic = CubicHermiteSpline(knots, rows[knots], slopes[knots])(np.arange(len(rows)))
        assert (np.abs(cubic - rows) <= 1.0001 * bound * np.abs(rows).max(axis=0) + 1e-15).all()
    assert sizes[1e-3] < sizes[1e-5] < sizes[1e-7] < len(rows)
    assert sizes[1e-5] < len(rows) / 10


def test_a_thinned_law_in_floats_follows_like_the_law(plan, tmp_path):
    law = sv.lqr(plan, sv.plant(CRANE), rate=500.0)
    whole, thinned = (sv.export_c(law, tmp_path / name, name="loop", **options)[0] for name, options in (
        ("whole", {}), ("thinned", {"thinned": 1e-5, "real": "float"})))  # fmt: skip
    assert thinned.stat().st_size < whole.stat().st_size / 10
    command = [*shlex.split(compiler()), *STRICT, "-fPIC", "-shared", str(thinned), "-o", str(tmp_path / "l.so"), "-lm"]
    assert subprocess.run(command, capture_output=True, text=True).stderr == ""
    c = ctypes.CDLL(str(tmp_path / "l.so"))
    u, z = np.empty(len(law.inputs), np.float32), np.zeros(1, np.float32)

    def step(t, measurement):
        y = np.array([measurement[name] for name in law.measures], np.float32)
        assert c.loop_step(ctypes.c_float(t), *(a.ctypes.data_as(ctypes.c_void_p) for a in (y, z, u))) == 0
        return u.astype(float)

    machine, given = sv.plant(CRANE, m_load=110.0), (plan.state(0.0), (0.0, 4.0))
    ours = sv.close(machine, step, *given, timing=sv.Timing(rate=500.0), plan=plan)
    exact = sv.close(machine, law, *given)
    stroke = np.ptp(exact["x"])
    assert np.abs(ours["x"] - exact["x"]).max() < 1e-4 * stroke
    before = u.copy()
    assert c.loop_step(ctypes.c_float(np.nan), *(a.ctypes.data_as(ctypes.c_void_p) for a in (u, z, u))) == -1
    assert np.array_equal(u, before)


def test_an_arm_follows_its_path_under_a_controller_in_floats(tmp_path):
    """A six-axis arm at 1 kHz: its exported law with thinned gains, in a plain loop around the plant in Python."""
    arm, mechanism, model, run = arm_plan()
    plant = sv.plant(mechanism, limits=arm.effort)
    source, _ = sv.export_c(sv.lqr(run, plant, rate=1000.0), tmp_path, name="loop", real="float", thinned=1e-5)
    command = [*shlex.split(compiler()), *STRICT, "-fPIC", "-shared", str(source), "-o", str(tmp_path / "l.so"), "-lm"]
    assert subprocess.run(command, capture_output=True, text=True).stderr == ""
    c, u, z = ctypes.CDLL(str(tmp_path / "l.so")), np.empty(6, np.float32), np.zeros(1, np.float32)
    rates, x, h = plant.function("ode"), np.array(model.start(guess=HOME).values), 1e-3
    worst, tool = 0.0, np.array([run[name] for name in arm.q.names])
    for k in range(2001):
        y = x.astype(np.float32)
        assert c.loop_step(ctypes.c_float(k * h), *(a.ctypes.data_as(ctypes.c_void_p) for a in (y, z, u))) == 0
        worst = max(worst, np.abs(x[:6] - tool[:, k // 2]).max() if k % 2 == 0 else 0.0)
        p = plant.p(u.astype(float))
        k1 = rates(k * h, x, p)
        k2 = rates(k * h, x + h / 2 * k1, p)
        k3 = rates(k * h, x + h / 2 * k2, p)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(k * h, x + h * k3, p))
    assert worst < 1e-3 * np.ptp(tool, axis=1).max()


def test_the_header_is_read_by_a_compiler_of_cplusplus(plan, tmp_path):
    if which("g++") is None:
        pytest.skip("needs g++")
    source, header = sv.export_c(sv.lqr(plan, sv.plant(CRANE)), tmp_path, name="loop", thinned=1e-4)
    (tmp_path / "main.cpp").write_text(
        '#include "loop.h"\nint main() { double y[LOOP_NY] = {}, z[1], u[LOOP_NU]; loop_start(z); return loop_step(0, y, z, u); }\n', encoding="utf-8"
    )
    for command in (["gcc", "-std=c99", "-c", str(source), "-o", str(tmp_path / "loop.o")],
                    ["g++", "-Wall", "-Wextra", str(tmp_path / "main.cpp"), str(tmp_path / "loop.o"), "-o", str(tmp_path / "run")],
                    [str(tmp_path / "run")]):  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
    assert header.exists()


ROS = """
#include <memory>
#include <vector>
#include "loop.h"
namespace rclcpp {
struct Duration { double s; double seconds() const { return s; } };
struct Time { double s = 0; Duration operator-(const Time &other) const { return {s - other.s}; } };
}
namespace rclcpp_lifecycle { struct State {}; struct Node { rclcpp::Time now() const { return {2.0}; } }; }
struct Interface { double value; double get_value() const { return value; } void set_value(double v) { value = v; } };
namespace controller_interface {
enum class return_type { OK, ERROR };
struct ControllerInterface {
    enum class CallbackReturn { SUCCESS };
    std::vector<Interface> state_interfaces_, command_interfaces_;
    std::shared_ptr<rclcpp_lifecycle::Node> get_node() const { return std::make_shared<rclcpp_lifecycle::Node>(); }
    virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
    virtual return_type update(const rclcpp::Time &, const rclcpp::Duration &) = 0;
    virtual ~ControllerInterface() = default;
};
}
%s
int main()
{
    LoopController own;
    controller_interface::ControllerInterface &c = own;
    double z[LOOP_NZ + 1], u[LOOP_NU], y[LOOP_NY];
    loop_start(z);
    c.command_interfaces_.resize(LOOP_NU);
    for (int i = 0; i < LOOP_NY; ++i) c.state_interfaces_.push_back({y[i] = 0.1 * i});
    c.on_activate({});
    bool same = c.update({2.5}, {0.01}) == controller_interface::return_type::OK && loop_step(0.5, y, z, u) == 0;
    for (int i = 0; i < LOOP_NU; ++i) same = same && c.command_interfaces_[i].get_value() == u[i];
    c.state_interfaces_[0].set_value(__builtin_nan(""));
    return same && c.update({2.51}, {0.01}) == controller_interface::return_type::ERROR ? 0 : 1;
}
"""


def test_the_controller_of_the_documents_gives_the_commands_of_the_law(plan, tmp_path):
    if which("g++") is None:
        pytest.skip("needs g++")
    page = (Path(__file__).parents[1] / "docs" / "c_export.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```cpp\n(.*?)```", page, re.S)
    source, _ = sv.export_c(sv.lqr(plan, sv.plant(CRANE), integral=True), tmp_path, name="loop", thinned=1e-4)
    (tmp_path / "main.cpp").write_text(ROS % shown, encoding="utf-8")
    for command in (["gcc", "-std=c99", "-c", str(source), "-o", str(tmp_path / "loop.o")],
                    ["g++", "-std=c++17", "-Wall", "-Wextra", str(tmp_path / "main.cpp"), str(tmp_path / "loop.o"), "-lm",
                     "-o", str(tmp_path / "run")],
                    [str(tmp_path / "run")]):  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")


DRIVER = """
#include <math.h>
#include "loop.h"
int main(void) {
    loop_real y[LOOP_NY], z[LOOP_NZ + 1], u[LOOP_NU];
    unsigned long seed = 1;
    int answered = 0, wrong = 0;
    loop_start(z);
    for (int k = -3; k < 2000; k++) {
        for (int i = 0; i < LOOP_NY; i++) {
            seed = (seed * 1103515245UL + 12345UL) % 2147483648UL;
            y[i] = (loop_real)(SIZE * ((double)seed / 1073741824.0 - 1.0));
        }
        if (k % 50 == 0) y[0] = k % 100 ? NAN : INFINITY;
        int status = loop_step((loop_real)(0.004 * k), y, z, u);
        answered += status == 0;
        wrong += (k % 50 == 0) != (status != 0);
        for (int i = 0; status == 0 && i < LOOP_NU; i++)
            wrong += !isfinite(u[i]);
    }
    return BOUNDED ? answered < 100 : wrong != 0;
}
"""
LIMITS = {"limits": {"trolley": 120.0}, "rate_limits": {"hoist": 500.0}}
WITHIN_LIMITS = {  # and the size of its random measurements; bounds may exclude limits there, and there is no answer
    "LQR": (lambda law: law, 1.0),
    "limited": (lambda law: sv.limited(law, sv.plant(CRANE, **LIMITS)), 1e3),
    "limited by priority": (lambda law: sv.limited(law, sv.plant(CRANE, **LIMITS), priority=["X", "Z"]), 1.0),
    "bounded": (lambda law: sv.limited(law, sv.plant(CRANE, **LIMITS), bounds={"tension": (900.0, 1060.0)}), 0.1),
}


@pytest.mark.parametrize(
    ("kind", "real", "tool"),
    [
        ("LQR", "float", "valgrind"),
        ("limited", "float", "sanitizers"),
        ("limited by priority", "double", "sanitizers"),
        ("bounded", "double", "valgrind"),
        ("bounded", "float", "sanitizers"),
    ],
)
def test_a_law_in_c_runs_without_a_complaint_of(kind, real, tool, plan, tmp_path):
    """Random measurements, every 50th of them infinite or no number, before the plan, along it and after its end."""
    if tool == "valgrind" and which("valgrind") is None:
        pytest.skip("needs valgrind")
    limited, size = WITHIN_LIMITS[kind]
    law = limited(sv.lqr(plan, sv.plant(CRANE), integral=True))
    source, _ = sv.export_c(law, tmp_path, name="loop", real=real, thinned=1e-4)
    facts = {"loop_real": real, "SIZE": repr(size), "BOUNDED": str(int(kind == "bounded"))}
    text = DRIVER
    for word, fact in facts.items():
        text = text.replace(word, fact)
    (tmp_path / "main.c").write_text(text, encoding="utf-8")
    flags = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"] if tool == "sanitizers" else ["-g"]
    run = tmp_path / "run"
    built = subprocess.run(["gcc", "-std=c99", *flags, str(tmp_path / "main.c"), str(source), "-o", str(run), "-lm"],
                           capture_output=True, text=True)  # fmt: skip
    if built.returncode and tool == "sanitizers":
        pytest.skip(f"needs a compiler with sanitizers: {built.stderr[:100]}")
    before = ["valgrind", "-q", "--error-exitcode=9"] if tool == "valgrind" else []
    done = subprocess.run([*before, str(run)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_options_of_the_export_are_refused_in_words(plan, tmp_path):
    law = sv.lqr(plan, sv.plant(CRANE))
    with refused(sv.errors.NameUnknown, "flaot", match="float"):
        sv.export_c(law, tmp_path, real="flaot")
    with refused(SpecificationError, "0"):
        sv.export_c(law, tmp_path, thinned=0.0)
    with refused(SpecificationError, "thinned"):
        sv.export_c(plan.model, tmp_path, thinned=1e-3)


def test_a_limited_law_of_a_python_function_is_refused(plan, tmp_path):
    own = sv.Law("held", (), ("trolley", "hoist"), 100.0, 0.0, lambda t, x, row: row, np.zeros((2, 1)), plan=plan)
    with refused(SpecificationError, "Python", law="held, limited by weight"):
        sv.export_c(sv.limited(own, sv.plant(CRANE, limits={"trolley": 120.0})), tmp_path)


def narrow(plan, **more):
    """The crane's LQR with integral, within limits that it meets, and a bound of the rope's tension."""
    limits = {"limits": {"trolley": 120.0}, "rate_limits": {"hoist": 500.0}}
    law = sv.lqr(plan, sv.plant(CRANE), integral=True)
    return sv.limited(law, sv.plant(CRANE, **limits), bounds={"tension": (900.0, 1060.0)}, **more)


def test_a_limited_law_in_floats_keeps_its_limits_and_its_loop(plan, tmp_path):
    law, machine = narrow(plan), sv.plant(CRANE, m_load=104.0)
    source, _ = sv.export_c(law, tmp_path, name="loop", real="float", thinned=1e-5)
    command = [*shlex.split(compiler()), *STRICT, "-fPIC", "-shared", str(source), "-o", str(tmp_path / "l.so"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    c, u, z = ctypes.CDLL(str(tmp_path / "l.so")), np.empty(2, np.float32), np.zeros(len(law.state), np.float32)
    c.loop_start(z.ctypes.data_as(ctypes.c_void_p))

    def answered(t, y):
        y = np.array(y, np.float32)
        return c.loop_step(ctypes.c_float(t), *(a.ctypes.data_as(ctypes.c_void_p) for a in (y, z, u)))

    def step(t, measurement):
        assert answered(t, [measurement[name] for name in law.measures]) == 0
        return u.astype(float)

    given = (plan.state(0.0), (0.0, 6.0))
    exact = sv.close(machine, law, *given)
    ours = sv.close(machine, step, *given, timing=sv.Timing(rate=100.0), plan=plan)
    met = np.mean([np.any(exact.signal[f"{kind} {name}"] != 0) for kind, name in law.allocation.limits])
    assert met == 1.0  # each limit, and the bound
    assert np.abs(ours["x"] - exact["x"]).max() < 1e-3 * np.ptp(exact["x"])
    assert np.abs(ours.commands[0]).max() <= 120.0
    before = u.copy(), z.copy()
    assert answered(1.0, [np.nan] * len(law.measures)) == -1
    assert answered(np.inf, plan.state(0.0)) == -1
    assert np.array_equal(before[0], u) and np.array_equal(before[1], z)
    heavy = narrow(plan, weights={"Z": 1e12})
    with refused(SpecificationError, "double", "4.1e+06", law=law.name):
        sv.export_c(heavy, tmp_path, real="float")
    sv.export_c(heavy, tmp_path)


def test_no_command_is_answered_where_limits_exclude_each_other(plan, tmp_path):
    machine = sv.plant(CRANE, limits={"trolley": 120.0, "hoist": (-1500.0, 0.0)})
    law = sv.limited(sv.lqr(plan, sv.plant(CRANE)), machine, bounds={"tension": (2000.0, None)})
    with refused(sv.errors.LimitExceeded, "tension"):
        sv.close(sv.plant(CRANE), law, plan.state(0.0), (0.0, 1.0))
    c, _ = library(law, tmp_path)
    u, z, y = np.full(2, 7.0), np.zeros(len(law.state)), plan.state(0.0)
    c.loop_start(z.ctypes.data_as(ctypes.c_void_p))
    before = z.copy()
    assert c.loop_step(ctypes.c_double(0.0), *(a.ctypes.data_as(ctypes.c_void_p) for a in (y, z, u))) == -1
    assert np.array_equal(u, [7.0, 7.0]) and np.array_equal(z, before)
