"""Numbers that decide: docs/numbers.md has them all, and the most important ones are pinned from both sides."""

import re
import runpy
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import servoctl as sv
from servoctl.errors import SingularProgram, SpecificationError
from servoctl.reduction.ranks import clean, decide
from servoctl.reduction.rows import dependence
from servoctl.tolerances import EXTENDED

ROOT = Path(__file__).parents[1]
PAGE = runpy.run_path(str(ROOT / "docs" / "numbers.py"))
CONSTANTS = {
    (path.relative_to(ROOT / "servoctl").as_posix(), name): comment
    for path in (ROOT / "servoctl").rglob("*.py")
    for name, _, comment in PAGE["constants"](path)
}


def test_the_page_is_written_from_the_sources():
    assert (ROOT / "docs" / "numbers.md").read_text(encoding="utf-8") == PAGE["page"](), "python docs/numbers.py"


def test_every_number_says_what_it_is():
    assert [place for place, comment in CONSTANTS.items() if not comment and not place[0].startswith("gallery/")] == []


def test_what_pins_a_number_exists():
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for place, told in PAGE["pinned"]().items():
        names = re.findall(r"test_\w+", told)
        assert place in CONSTANTS, place
        assert told == "none" or names and all(f"def {name}(" in tests for name in names), place


# pinned from both sides: each of these fails where its number is ten times larger, and where it is ten times smaller --


@pytest.mark.parametrize("difference, zero", [(6e-12, False), (6e-13, True)])
def test_entry_a_difference_is_zero_below_1e_12_of_its_terms(difference, zero):
    """Two gear ratios of 1: what is left of their difference is rounding, or a coupling."""
    q = sv.coordinates("x y")
    p = sv.parameters(m=1.0, first=1.0 + difference, second=1.0)
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, (x, y)), actuators={"f": x, "g": y}, parameters=p)
    program = sv.Program({"a": x + (p.first - p.second) * y - ca.sin(q.t), "b": y - q.t})
    reduction = sv.derive(mechanism, program).reduction
    entries = clean(*reduction.points.matrix(reduction.rows[0].gradient(mechanism.q)))
    assert np.all(entries[0, 1] == 0.0) == zero


@pytest.mark.parametrize("pivot, rank", [(3e-9, 2), (3e-10, 2), (3e-11, 1)])
def test_resolved_a_pivot_counts_above_1e_10(pivot, rank):
    """Rows (1, 1) and (1, 1 + pivot): elimination leaves the pivot."""
    found = decide(np.array([[1.0, 1.0], [1.0, 1.0 + pivot]]))
    assert found.rank == rank
    assert found.clear == (rank == 2)


@pytest.mark.skipif(not EXTENDED, reason="without extended precision the noise is that of double precision")
@pytest.mark.parametrize("pivot, zero", [(8e-15, True), (2e-14, False), (8e-13, False), (8e-11, False)])
def test_noise_a_pivot_below_1e_14_is_zero_and_up_to_1e_10_undecided(pivot, zero):
    """Rows (1, 1) and (1, 1 + pivot)."""
    found = decide(np.array([[1, 1], [1, 1 + np.longdouble(pivot)]], dtype=np.longdouble))
    assert found.rank == 1 and found.clear == zero


@pytest.mark.skipif(not EXTENDED, reason="without extended precision the noise is that of double precision")
def test_noise_rounding_of_terms_hundreds_of_times_as_large_as_an_entry_is_zero():
    """Rows (x, y) and (x, y) again, the second with terms of 200 that cancel: they depend on each other."""
    x, y = np.random.default_rng(1907).uniform(3.0, 6.0, (2, 200)).astype(np.longdouble) / 3
    found = [decide(np.array([[a, b], [(a + 200) - 200, (b + 200) - 200]])) for a, b in zip(x, y, strict=True)]
    assert all(rank.rank == 1 and rank.clear for rank in found)


@pytest.mark.parametrize("rest, depends", [(1e-10, False), (1e-11, True)])
def test_dependent_a_row_is_a_combination_of_others_up_to_1e_11(rest, depends):
    rows = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 2.0 + rest]])
    support, _ = dependence(rows[:, :, None])
    assert support == ([0, 1, 2] if depends else [])


@pytest.mark.parametrize("slope, regular", [(3e-5, True), (3e-6, False)])
def test_vanished_a_gradient_is_lost_on_its_solutions_below_1e_5(slope, regular):
    """ε u + u - w tanh(u/w) with u = x - t and w = 0.01 has the gradient ε on x = t, and 1 + ε beside it."""
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x), actuators={"force": x})
    u = x - q.t
    program = sv.Program({"a": (1.0 + slope) * u - 0.01 * ca.tanh(100.0 * u)})
    if regular:
        assert sv.derive(mechanism, program).free == 0
    else:
        with pytest.raises(SingularProgram) as caught:
            sv.derive(mechanism, program)
        assert caught.value.details["row"] == "a"


@pytest.mark.parametrize("excess, negative", [(1e-8, True), (1e-9, False)])
def test_negative_an_inertia_is_negative_below_1e_9_of_its_size(excess, negative):
    """The eigenvalues of [[1, 1], [1, 1 - δ]] are 2 and -δ/2."""
    q = sv.coordinates("x y")
    x, y = q
    ddx, ddy = q.d(2)
    mechanism = sv.Mechanism(q, gibbs=(ddx**2 + 2 * ddx * ddy + (1 - excess) * ddy**2) / 2)
    program = sv.Program({"a": x - ca.sin(q.t)}, by="ideal")
    if negative:
        with pytest.raises(SpecificationError) as caught:
            sv.derive(mechanism, program)
        assert set(caught.value.details["names"]) == {"dx", "dy"}
    else:
        assert sv.derive(mechanism, program).free == 2


@pytest.mark.parametrize("twist, integrable", [(5e-9, False), (5e-10, True)])
def test_integrable_a_frame_is_integrable_up_to_1e_9(twist, integrable):
    """The bracket of (1, 0, 0) and (0, 1, ε x) is (0, 0, ε), outside their span."""
    q = sv.coordinates("x y z")
    x = list(q)[0]
    q = q.with_quasi_velocities("u v", [[1, 0], [0, 1], [0, twist * x]])
    u, v = q.w()
    if integrable:
        sv.Mechanism(q, kinetic=(u**2 + v**2) / 2)
    else:
        with pytest.raises(SpecificationError):
            sv.Mechanism(q, kinetic=(u**2 + v**2) / 2)
