"""Published problems (benchmarks/published.py): digits by the default, the method that it takes, and how many steps."""

import pytest

import servoctl as sv
from benchmarks.published import PROBLEMS, prepared

COMPILED = ("Taylor", "RadauIIA")
EXPECTED = {  # digits that the default keeps, methods of which it takes one, steps at most
    "pendulum 10 s": (10.0, COMPILED[:1], 130),
    "pendulum 100 s": (6.8, COMPILED[:1], 1300),
    "pendulum 1000 s": (3.8, COMPILED[:1], 13000),
    "car axis": (7.8, COMPILED, 360),
    "andrews": (6.5, ("DOP853",), 120),  # too few steps to pay for compiling an implicit method
    "slider crank": (10.4, COMPILED[1:], 2500),
    "fekete": (8.2, ("DOP853",), 850),  # whose implicit method takes 25 s to compile
    "governor": (8.8, COMPILED[1:], 240),
    "bricard": (8.0, ("DOP853",), 90),
    "rattleback": (7.2, COMPILED[1:], 4800),
    "snakeboard": (9.5, COMPILED, 210),
    "flexible arm": (13.0, ("algebraic",), None),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_the_default_is_right_and_takes_a_method_that_suits_the_problem(name):
    problem, (digits, methods, most) = PROBLEMS[name], EXPECTED[name]
    model, start = prepared(problem)
    run = sv.simulate(model, start, (0.0, problem.until))
    found = problem.digits({entry: run[entry][-1] for entry in problem.truth()})
    assert run.success and run.method in methods, run.message
    assert found > digits, found
    assert most is None or run.counters["steps"] <= most, run.counters


def test_every_problem_is_tested():
    assert EXPECTED.keys() == PROBLEMS.keys()
