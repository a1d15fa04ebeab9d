"""The examples run, and their numbers are those of closed forms and of independent integrations."""

import re
import runpy
from pathlib import Path

import closed_forms as known
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS, DOCS = sorted(EXAMPLES.glob("*.py")), EXAMPLES.parent / "docs"


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_every_example_explains_itself_and_runs_as_a_script(path):
    text = path.read_text(encoding="utf-8")
    assert text.startswith('"""')
    assert 'if __name__ == "__main__":' in text


def appell_hamel(result):
    assert result["free"] == 6
    state = [result[name] for name in ("x", "y", "z", "phi", "theta", "dphi", "dtheta")]
    assert np.abs(np.array(state) - known.APPELL_HAMEL_STATES[2.0]).max() < 1e-8
    assert result["energy drift"] < 1e-8


def overhead_crane(result):
    assert (result["free"], result["index"]) == (0, 5)
    exact = known.overhead_crane(np.linspace(0.0, 8.0, 80_001))
    for name in ("trolley", "hoist", "theta"):
        assert result[f"{name} min"] == pytest.approx(exact[name].min(), rel=1e-6)
        assert result[f"{name} max"] == pytest.approx(exact[name].max(), rel=1e-6)
    printed = {"trolley": (-137.991607, 134.331943), "hoist": (-1044.370897, -935.793762)}
    for name, (least, greatest) in printed.items():
        assert (result[f"{name} min"], result[f"{name} max"]) == pytest.approx((least, greatest), abs=1e-6)
    assert np.rad2deg([result["theta min"], result["theta max"]]) == pytest.approx((-7.1814, 7.9766), abs=1e-4)


def two_cars(result):
    assert result["ideal max"] == pytest.approx(6.852059, abs=1e-6)
    assert result["ideal at"] == pytest.approx(0.7091, abs=1e-4)
    assert result["ideal swing"] == pytest.approx(1.966911, abs=1e-6)
    assert result["actuators max"] == pytest.approx(316.175102075, rel=1e-9)
    assert result["actuators at"] == pytest.approx(1.248527, abs=1e-6)
    assert result["actuators swing"] < 1e-9
    assert (result["ideal free"], result["actuators free"]) == (2, 0)
    assert result["ideal outside"] == pytest.approx(1.0)
    t = np.linspace(0.0, 2.0, 20_001)
    assert result["ideal max"] == pytest.approx(known.cars_ideal(t)["reaction"].max(), rel=1e-7)
    assert result["actuators max"] == pytest.approx(known.cars(t)["force"].max(), rel=1e-6)


def spiral(result):
    exact = known.spiral(np.array(2.0), 5, c=1.5)
    assert result["free"] == 7
    assert result["heading"] == pytest.approx(1.0, abs=1e-9)
    assert (result["x"], result["y"]) == pytest.approx((float(exact["x"]), float(exact["y"])), abs=1e-9)
    assert result["speed error"] < 1e-8


def redundant_thrusters(result):
    for case in ("equal", "weak bow", "wish"):
        assert result[f"{case} against the least norm"] < 1e-12 and result[f"{case} verified"]
    assert result["weak bow bow"] < result["equal bow"] / 3
    assert result["weak bow stern"] > result["equal stern"]
    assert result["wish bow"] > result["equal bow"] + 1.0


def quaternion(result):
    t = np.linspace(0.0, 10.0, 1001)
    rate, acceleration = (known.rest_to_rest(t, k, 0.0, np.pi / 3, 10.0, 2) for k in (1, 2))
    torque = np.hypot(40.0 * acceleration, 60.0 * 0.5 * rate)
    assert result["torque max"] == pytest.approx(torque.max(), rel=1e-9)
    assert result["free"] == 2
    assert result["spin change"] < 1e-12
    assert result["unit error"] < 1e-14


def designed_arm(result):
    """Both torques are at a limit."""
    assert result["designed [s]"] == pytest.approx(0.718014, abs=1e-5)
    assert (result["via x [m]"], result["via y [m]"]) == pytest.approx((0.44518, 0.62279), abs=1e-4)
    assert 45.0 * (1 - 1e-5) < result["shoulder [N m]"] <= 45.0 and 5.0 * (1 - 1e-5) < result["elbow [N m]"] <= 5.0
    assert result["gain"] < 1e-4


def robot_arm(result):
    """Without an integral the unknown 2 kg deflect the arm as its gains are stiff; with it they are carried."""
    assert result["free"] == 0
    assert result["LQR: at the end [mm]"] > 20 * result["LQR with integral: at the end [mm]"]
    assert result["LQR with integral: at the end [mm]"] < 1.0 and result["LQR with integral: at the end [mrad]"] < 1.0


# closed loops ----------------------------------------------------------------------------------------------------------

LOST = 15.0 * 9.81  # N: the weight that the crane's laws do not know of
PATH_END, END = "at 6 s [mm]", "at the end [mm]"


def closed_loop_crane_falls_under_feedforward_alone(result):
    assert result[f"feedforward: {PATH_END}"] == pytest.approx(22.4e3, rel=0.01)
    for what, t in ((PATH_END, 6.0), (END, 8.0)):  # hoist and load, 120 kg, under the weight that nothing carries
        assert result[f"feedforward: {what}"] == pytest.approx(1e3 * LOST / 120.0 * t**2 / 2, rel=0.02)


def closed_loop_crane_deflects_as_each_law_is_stiff(result):
    """What remains without an integral: weight over gain; for computed, 6 T² of the acceleration that is wrong."""
    assert result[f"PD: {END}"] == pytest.approx(1e3 * LOST / 8000.0, rel=0.03)
    assert result[f"LQR: {END}"] == pytest.approx(1e3 * LOST / 1000.0, rel=0.03)
    for T in (0.25, 0.06):
        assert result[f"computed, {T} s: {END}"] == pytest.approx(1e3 * 6 * T**2 * LOST / 105.0, rel=0.002)


def closed_loop_crane_comes_back_where_the_law_integrates_or_knows(result):
    assert 140.0 <= result[f"LQR: {PATH_END}"] <= 160.0
    for name, worst, at_6, end in (
        ("LQR with integral", 60.0, 10.0, 3.0),
        ("output feedback", 60.0, 10.0, 3.0),
        ("limited", 60.0, 25.0, 5.0),
        ("computed, 0.25 s, load known", 20.0, 0.2, 0.01),
    ):
        errors = [result[f"{name}: {what}"] for what in ("worst [mm]", PATH_END, END)]
        assert np.all(np.array(errors) <= [worst, at_6, end]), name
    assert result["computed, 0.25 s, as planned: worst [mm]"] < 0.03, "what the hold leaves"
    assert result["limited: trolley [N]"] <= 150.0 < result["LQR with integral: trolley [N]"]


def closed_loop_crane_with_noise_and_delay(result):
    """Little worse than without; but poles of 1/0.06 s turn the noise into a hundred times the plan's force."""
    for name in ("PD", "computed, 0.25 s", "LQR", "LQR with integral", "output feedback"):
        quiet, noisy = (result[f"{before}{name}: worst [mm]"] for before in ("", "noise, "))
        assert noisy == pytest.approx(quiet, rel=0.03)
        assert result[f"noise, {name}: {END}"] <= result[f"{name}: {END}"] + 1.0
    assert result["noise, limited: trolley [N]"] <= 150.0 and result["noise, limited: worst [mm]"] < 90.0  # 52 .. 86 by seed
    assert result["noise, computed, 0.06 s: trolley [N]"] > 100 * result["feedforward: trolley [N]"]
    assert result["noise, LQR with integral: trolley [N]"] < 400.0


def closed_loop_crane_with_a_weak_trolley(result):
    """The plan needs 138 N of 100: bounded by allocation, and slowed to 80 N it runs without slack."""
    assert result["the plan needs [N]"] == pytest.approx(-137.991607, abs=1e-5)
    for name in ("overloaded, clipped", "overloaded, limited", "slowed"):
        assert result[f"{name}: trolley [N]"] <= 100.0
    assert result[f"overloaded, limited: {END}"] < 0.5 * result[f"overloaded, clipped: {END}"]
    assert result["overloaded, limited: worst [mm]"] < 2000.0
    assert (137.99 / 80.0) ** 0.5 == pytest.approx(result["reserve factor"], rel=0.02)  # accelerations go with 1/σ²
    assert result["slowed: residuals that gave way"] == 0
    assert result["slowed: worst [mm]"] < 60.0 and result[f"slowed: {END}"] < 0.1


MACHINES = {  # at most: worst and last error (m, rad); feedforward alone is worse by at least this factor
    "two cars": (0.02, 1e-3, 10),
    "mass on car": (4e-3, 1e-3, 50),
    "3-D crane": (0.08, 0.015, 100),
    "wheeled robot": (0.11, 0.015, 10),
    "two-link arm": (4e-3, 1e-3, 100),
    "pendubot": (0.21, 5e-3, 20),
}


def closed_loops_stay_near_their_plans(result):
    for name, (worst, last, factor) in MACHINES.items():
        assert result[f"{name}: worst"] < worst and result[f"{name}: last"] < last, name
        assert result[f"{name}: feedforward worst"] > factor * result[f"{name}: worst"], name


def closed_loops_show_what_computed_actuation_cannot_do(result):
    """A curvature says nothing of the place; and the upright pendubot's eigenvalue is that of its linearisation."""
    assert result["wheeled robot: computed last"] > 5 * result["wheeled robot: last"]
    inertia, torque, damping = 0.07 + 3.0 * 0.25**2, 3.0 * 9.81 * 0.25, 0.05  # of the second link about the elbow
    assert result["pendubot: eigenvalue"] == pytest.approx(max(np.roots([inertia, damping, -torque])), rel=1e-4)


def the_table_of_other_machines_is_what_the_example_says(result):
    page = (DOCS / "closed_loop.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", page, re.M)
    assert [row[0] for row in rows] == list(MACHINES)
    for name, *cells in rows:
        for cell, what in zip(cells, ("worst", "last", "feedforward worst"), strict=True):
            digits = len(cell.partition(".")[2])
            assert cell == f"{result[f'{name}: {what}']:.{digits}f}"


# every example -------------------------------------------------------------------------------------------------------

CHECKS = {  # of what an example returns; it has a check of its name, or these
    "closed_loop_crane": (
        closed_loop_crane_falls_under_feedforward_alone, closed_loop_crane_deflects_as_each_law_is_stiff,
        closed_loop_crane_comes_back_where_the_law_integrates_or_knows, closed_loop_crane_with_noise_and_delay,
        closed_loop_crane_with_a_weak_trolley,
    ),
    "closed_loops": (
        closed_loops_stay_near_their_plans, closed_loops_show_what_computed_actuation_cannot_do,
        the_table_of_other_machines_is_what_the_example_says,
    ),
    **{check.__name__: (check,) for check in (
        appell_hamel, overhead_crane, two_cars, spiral, redundant_thrusters, quaternion, designed_arm, robot_arm,
    )},
}  # fmt: skip


def in_the_page():
    """{example: ((name of a number, number as text), ...)} of docs/examples.md."""
    page = (DOCS / "examples.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[(\w+)\]\(.*?\) \| [^|]+ \| (.*) \|$", page, re.M)
    return {name: re.findall(r"`([^`]+)` (-?[\d.]*\d)", cell) for name, cell in rows}


def test_the_page_of_examples_has_all_of_them():
    assert sorted(in_the_page()) == [path.stem for path in SCRIPTS] and sum(map(len, in_the_page().values())) > 20


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_every_example_is_verified_and_returns_numbers(path, as_shipped):
    """Those of the page, and of its checks."""
    result = runpy.run_path(str(path))["main"](fast=True)
    verified = [value for name, value in result.items() if name.endswith("verified")]
    assert verified and all(verified)
    assert all(np.isfinite(value) for value in result.values())
    for what, number in in_the_page()[path.stem]:
        assert number == f"{result[what]:.{len(number.partition('.')[2])}f}", what
    for check in CHECKS.get(path.stem, ()):
        check(result)


def test_checks_are_of_examples():
    assert {*CHECKS} <= {path.stem for path in SCRIPTS}
