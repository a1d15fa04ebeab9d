"""What a reader takes "passed" for: each row a plan or a loop that is right and not sensible, and what is said of it."""

import re
import subprocess
import sys
import warnings
from functools import cache

import casadi as ca
import numpy as np
import pytest

import servoctl as sv
from servoctl.gallery import gallery

G = 9.81


# a first transient ----------------------------------------------------------------------------------------------------


@cache
def pulled(k, c, M, m=2.0, w=3.0):
    """A load m follows sin(wt), pulled by a car M through a spring k and a damper c: the car tends to it as e^(-kt/c)."""
    q = sv.coordinates("x y", units="m m")
    (x, y), (dx, dy) = q, q.d(1)
    mechanism = sv.Mechanism(
        q, sv.particle(q, M, x) + sv.particle(q, m, y), potential=k * (y - x) ** 2 / 2,
        forces={"x": c * (dy - dx), "y": -c * (dy - dx)}, actuators={"drive": x},
    )  # fmt: skip
    steady = (k - m * w**2 + 1j * c * w) / (k + 1j * c * w)  # of the car, relative to the load
    peak = abs(-(w**2) * (M * steady + m))
    return sv.derive(mechanism, sv.Program({"load": y - ca.sin(w * q.t)})), steady.imag, peak


def crane(moving, c=5.0):
    """The README's crane with a damped rope, from rest or along a path that never rests."""
    q = sv.coordinates("x l theta", units="m m rad")
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    S = sv.particle(q, 10.0, x) + sv.particle(q, 5.0, l) + sv.particle(q, 100.0, load)
    s = q.references(s=sv.paths.rest_to_rest(0.0, 1.0, 6.0, smoothness=4)).s
    X, Z = (2 * ca.sin(q.t), 3.0) if moving else (5 * s, 4 - 2 * s)
    mechanism = sv.Mechanism(
        q, S, potential=-100.0 * G * load[1], forces={"theta": -c * q.d(1)[2]}, actuators={"trolley": x, "hoist": l}
    )
    return sv.derive(mechanism, sv.Program({"X": load[0] - X, "Z": load[1] - Z}))


def warned(model, start, span):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        run = sv.simulate(model, start, span)
    return run, [str(each.message) for each in said if "first transient" in str(each.message)]


def found(model, sentence):
    """The start that a sentence gives."""
    return eval(re.search(r"model\.start\(.*\)", sentence)[0], {"model": model})


@pytest.mark.parametrize("k, c, M", [(800.0, 1.0, 5.0), (4000.0, 2.0, 1.0), (60.0, 3.0, 40.0)])
def test_a_first_transient_is_named_with_the_start_that_has_none(k, c, M):
    model, steady, peak = pulled(k, c, M)
    run, said = warned(model, model.start(guess={"x": 0.3}), (0.0, 6.0))
    assert (
        len(said) == 1 and said[0].startswith("drive has a first transient of") and "x = 0.3 was left free" in said[0]
    )
    assert abs(run["drive"][0]) > 1.1 * peak
    assert float(re.search(r"at most (\S+) later", said[0])[1]) == pytest.approx(peak, rel=1e-3)
    start = found(model, said[0])
    assert start["x"] == pytest.approx(steady, abs=1e-3)
    again, more = warned(model, start, (0.0, 6.0))
    assert more == [] and np.abs(again["drive"]).max() == pytest.approx(peak, rel=1e-3)
    verification = sv.verify(run)
    assert verification.passed and verification.remarks[0] == said[0].removesuffix(".")
    assert verification.remarks[0] in repr(verification).splitlines()[1]


@pytest.mark.parametrize(
    "moving, held, guess",
    [(False, {"dx": -39.0}, {"l": 4.0}), (False, {"x": 0.05}, {"l": 4.0}), (True, {}, {"l": 3.0, "x": 0.05})],
)
def test_of_a_crane_with_a_damped_rope(moving, held, guess):
    model = crane(moving)
    run, (said,) = warned(model, model.start(guess=guess, **held), (0.0, 8.0))
    assert all(f"{name} = {value:.4g} was held" in said for name, value in held.items())
    again, more = warned(model, found(model, said), (0.0, 8.0))
    assert more == [] and np.abs(again["trolley"]).max() < 0.01 * np.abs(run["trolley"][0])


def test_the_start_without_a_transient_is_sought_once(gallery_model, monkeypatch):
    """A rest, and where a motion has come to that began earlier: each by two starts, and no call where forces stay."""
    model, scene = gallery_model("tumbling-satellite"), gallery["tumbling-satellite"]
    model = model.with_parameters()
    start, counted, made = model.start(**scene.start, guess=scene.guess), [], type(model).start
    monkeypatch.setattr(type(model), "start", lambda *given, **held: counted.append(held) or made(*given, **held))
    for expected in (4, 0):
        assert warned(model, start, scene.t_span)[1] == [] and len(counted) == expected
        counted.clear()


def decaying(q):
    return ca.exp(-q.t)


@pytest.mark.parametrize("path", [decaying, lambda q: ca.cos(3 * q.t), lambda q: 0.2 * q.t])
def test_a_force_that_the_program_needs_at_first_is_no_transient(path):
    q = sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    mechanism = sv.Mechanism(
        q, sv.particle(q, 1.0, x) + sv.particle(q, 2.0, y), forces={"y": -3.0 * (dy - dx), "x": 3.0 * (dy - dx)},
        actuators={"drive": x},
    )  # fmt: skip
    model = sv.derive(mechanism, sv.Program({"place": x - path(q)}))
    speed = float(ca.Function("v", [q.t], [ca.jacobian(path(q), q.t)])(0.0))
    assert warned(model, model.start(guess={"y": 0.0, "dy": speed}), (0.0, 6.0))[1] == []


def test_rests_and_swings_that_go_on_are_no_transients():
    model = crane(False)
    assert warned(model, model.start(guess={"l": 4.0, "x": 0.05}), (0.0, 8.0))[1] == []
    q = sv.coordinates("x theta")
    x, theta = q
    bob = ca.vertcat(x + ca.sin(theta), -ca.cos(theta))
    mechanism = sv.Mechanism(
        q, sv.particle(q, 1.0, x) + sv.particle(q, 0.5, bob), potential=0.5 * G * bob[1], actuators={"drive": x}
    )
    swinging = sv.derive(mechanism, sv.Program({"place": x}))
    assert warned(swinging, swinging.start(theta=0.3), (0.0, 8.0))[1] == []


# weights, limits, growth, samples -------------------------------------------------------------------------------------


def lifted(times, **options):
    """A mass of 3 kg on a rope swings up and down with so many g."""
    q = sv.coordinates("z", units="m")
    (z,) = q
    mechanism = sv.Mechanism(q, sv.particle(q, 3.0, z), potential=3.0 * G * z, actuators={"rope": z}, **options)
    return sv.derive(mechanism, sv.Program({"Z": z - times * G / 25 * ca.cos(5 * q.t)}))


def remarks(model, start=None, span=(0.0, 4.0), **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = sv.simulate(model, start or model.start(), span, **options)
    verification = sv.verify(run)
    assert verification.passed and len(repr(verification).splitlines()) <= 8
    assert all(said in verification.details for said in verification.remarks)
    assert [said for said in verification.remarks if said in repr(verification)] == [*verification.remarks[:1]]
    return verification.remarks


@pytest.mark.parametrize("times, said", [(12.0, "13 times"), (30.0, "31 times"), (8.0, "")])
def test_a_force_above_ten_times_the_weights(times, said):
    told = remarks(lifted(times))
    assert [f"rope is {3 * G * (1 + times):.4g} N" in one and said in one for one in told] == [True] * bool(said)


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_weights_do_not_hang_on_units_or_springs(unit):
    """A cart with a pole, in m or mm: the pole weighs 2 N at 1 m, and the cart's force is 20 times as much."""
    q = sv.coordinates("x theta")
    x, theta = q
    tip = ca.vertcat(x / unit + ca.sin(theta), ca.cos(theta))
    S = sv.particle(q, 0.2, x / unit) + sv.particle(q, 0.2, tip)
    amplitude = 40 * 0.2 * G / (0.4 * 100)
    actuators = {"cart": x / unit, "hip": theta}
    for spring, said in ((0.0, True), (1e3, True)):
        potential = 0.2 * G * tip[1] + spring * (x / unit) ** 2 / 2
        program = sv.Program({"X": x / unit - amplitude * ca.cos(10 * q.t), "up": theta})
        model = sv.derive(sv.Mechanism(q, S, potential=potential, actuators=actuators), program)
        assert [one.split()[0] for one in remarks(model)] == ["cart"] * said + ["hip"] * said
    model = sv.derive(sv.Mechanism(q, S, potential=1e-3 * (x / unit) ** 2, actuators=actuators), program)
    assert remarks(model) == ()  # no gravity


ARM = """<robot name="arm"><link name="base"/>
<link name="one"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
<limit lower="-1.57" upper="1.57" effort="{effort}" velocity="9"/></joint></robot>"""


@pytest.mark.parametrize(
    "angle, effort, said",
    [(3.77, 500, "hip is 3.77 rad"), (-1.6, 500, "hip is -1.6 rad"), (1.5, 5, "torque_hip is"), (1.5, 500, "")],
)
def test_limits_of_a_robots_file(angle, effort, said):
    robot = sv.urdf(ARM.format(effort=effort))
    mechanism = robot.mechanism()
    q = mechanism.q
    program = sv.Program({"hip": q["hip"] - q.references(hip=sv.paths.rest_to_rest(0.0, angle, 3.0)).hip}, by="actuators")
    told = remarks(sv.derive(mechanism, program))
    assert [one.startswith(said) and "beyond its limit of" in one for one in told] == [True] * bool(said)


@pytest.mark.parametrize("limits, said", [({"rope": (0, None)}, "rope is -58.86 N"), ({"dz": 5.0}, "dz is"), ({}, "")])
def test_limits_that_a_mechanism_declares(limits, said):
    told = remarks(lifted(3.0, limits=limits))
    assert [one.startswith(said) for one in told] == [True] * bool(said)
    with pytest.raises(sv.errors.NameUnknown, match="'rpoe'.*'rope'"):
        lifted(3.0, limits={"rpoe": 1.0})


def test_growth_of_the_internal_dynamics():
    mechanism, program = sv.gallery.cart_pole()
    model = sv.derive(mechanism, program)
    assert remarks(model, span=(0.0, 2.0))[0].startswith("internal dynamics unstable")


@pytest.mark.parametrize("samples, said", [(5, True), (2001, False)])
def test_steps_that_outnumber_samples(samples, said):
    q = sv.coordinates("x", units="m")
    model = sv.derive(sv.Mechanism(q, sv.particle(q, 1.0, q["x"]), actuators={"F": q["x"]}),
                      sv.Program({"X": q["x"] - ca.sin(20 * q.t)}))  # fmt: skip
    told = remarks(model, t_eval=np.linspace(0.0, 4.0, samples))
    assert [f"for {samples} samples" in one for one in told] == [True] * said


# closed loops ---------------------------------------------------------------------------------------------------------

SHAKEN = '''"""A pendulum whose pivot is shaken."""
import casadi as ca
import servoctl as sv

START, T_SPAN = {"theta": 0.1}, (0.0, 1.0)


def scene(hertz=32, amplitude=0.02):
    q = sv.coordinates("z theta", units="m rad")
    z, theta = q
    tip = ca.vertcat(0.2 * ca.sin(theta), z + 0.2 * ca.cos(theta))
    S = sv.particle(q, 1.0, z) + sv.particle(q, 0.2, tip)
    U = 9.81 * z + 0.2 * 9.81 * tip[1]
    mechanism = sv.Mechanism(q, S, potential=U, forces={"theta": -0.001 * q.d(1)[1]}, actuators={"shaker": z})
    return mechanism, sv.Program({"Z": z - amplitude * ca.cos(2 * ca.pi * hertz * q.t)})
'''


def shaken(**options):
    names = {}
    exec(SHAKEN, names)
    mechanism, program = names["scene"](**options)
    model = sv.derive(mechanism, program)
    return sv.simulate(model, model.start(theta=0.1), (0.0, 1.0)), sv.plant(mechanism)


@pytest.mark.parametrize("hertz, rate", [(32, 100.0), (20, 50.0), (3, 200.0)])
def test_a_loop_that_is_too_slow_for_its_path(hertz, rate):
    plan, plant = shaken(hertz=hertz)
    closed = sv.close(plant, sv.lqr(plan, plant, rate), plan.state(0.0), (0.0, 1.0))
    off = np.abs(closed.residual["Z"][0]).max() / 0.04
    told = [one for one in sv.verify(closed).remarks if "path's own size" in one]
    assert len(told) == (off > 1 / 3) == (hertz > 3)
    assert all(one.startswith(f"{rate / hertz:.2g} samples per period") and f"{off:.2g} times" in one for one in told)


@pytest.mark.parametrize("stiffness, said", [(400.0, ""), (8e3, "1.6 samples"), (2e4, "1 samples")])
def test_a_loop_with_few_samples_in_the_fastest_time_constant(stiffness, said):
    """Two masses of 4 kg on a spring swing with (2 k / 4)^(1/2)."""
    q = sv.coordinates("x y")
    x, y = q
    S = sv.particle(q, 4.0, x) + sv.particle(q, 4.0, y)
    mechanism = sv.Mechanism(q, S, potential=stiffness * (y - x) ** 2 / 2, actuators={"F": x, "G": y})
    program = sv.Program({"X": x - q.references(X=sv.paths.rest_to_rest(0.0, 1.0, 2.0)).X, "Y": y - x})
    model, plant = sv.derive(mechanism, program), sv.plant(mechanism)
    plan = sv.simulate(model, model.start(), (0.0, 2.0))
    closed = sv.close(plant, sv.lqr(plan, plant, 100.0), plan.state(0.0), (0.0, 2.0))
    assert [one.startswith(said) for one in sv.verify(closed).remarks] == [True] * bool(said)


# the command ----------------------------------------------------------------------------------------------------------

SEGWAY = '''"""A Segway by its speed."""
import casadi as ca
import servoctl as sv

T_SPAN = (0.0, 6.0)


def scene():
    q = sv.coordinates("x pitch", units="m rad")
    x, pitch = q
    rider = ca.vertcat(x + 0.9 * ca.sin(pitch), 0.9 * ca.cos(pitch))
    S = sv.particle(q, 10.0, x) + sv.particle(q, 70.0, rider)
    mechanism = sv.Mechanism(q, S, potential=70.0 * 9.81 * rider[1], actuators={"wheel": x})
    r = q.references(speed=sv.paths.rest_to_rest(0.0, 1.0, 2.0))
    return mechanism, sv.Program({"speed": q.d(1)[0] - r.speed})
'''


def command(folder, text, *options):
    """What `servoctl run` prints of a scene's file, its run, and the first words of its page."""
    (folder / "scene.py").write_text(text)
    line = [sys.executable, "-m", "servoctl", "run", "scene.py", "--out", "out", "--no-figures", *options]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (folder / "out" / "index.html").read_text()
    return " ".join(done.stdout.split()), sv.load(folder / "out" / "run.npz"), re.search('"verdict">([^<]*)', page)[1]


@pytest.mark.parametrize("options", [(), ("--samples", "201")])
def test_the_command_takes_the_plan_that_the_inverse_takes(options, tmp_path):
    said, run, _ = command(tmp_path, SEGWAY, *options)
    assert np.abs(run["pitch"]).max() < 0.3 and np.abs(run["dx"] - 1.0)[run.t > 4.0].max() < 0.05
    assert "Verification: passed" in said and f"method {run.method}" in said
    assert run.method in ("relaxed", "bounded") and (len(run.t) == 201 or not options)
    names = {}
    exec(SEGWAY, names)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert sv.inverse(*names["scene"](), names["T_SPAN"]).method == run.method


def test_the_rate_of_the_command_comes_from_the_plan(tmp_path):
    said, _, _ = command(tmp_path, SHAKEN)
    assert "The loop runs at 610 Hz, not 100: 3 samples" in said and "path's own size" not in said
    said, _, headline = command(tmp_path, SHAKEN, "--rate", "100")
    assert "Loop: 3.1 samples per period of the plan; the loop's error of Z is" in said
    assert "verification passed. Shaker is" in headline and "times the weights" in headline
