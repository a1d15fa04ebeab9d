"""Steps of the Taylor method: their length, compiled and interpreted alike, and jets within them."""

import numpy as np
import pytest

import servoctl as sv
from servoctl.codegen.interpreted import rough_log2
from servoctl.gallery import gallery
from servoctl.methods.taylor import series_loop
from servoctl.simulation import simulated


def test_the_logarithm_of_steps_is_within_a_hundredth():
    numbers = np.geomspace(1e-300, 1e300, 20_001)
    assert np.abs(rough_log2(numbers) - np.log2(numbers)).max() < 0.01
    assert rough_log2(0.0) == -1023 and rough_log2(np.inf) == 1024 and rough_log2(np.nan) > 1024


@pytest.mark.parametrize("order", [4, 5, 9, 12, 13, 20])
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_coefficient_that_vanishes_does_not_lengthen_the_step(order, speed, oscillator):
    """At the turning point of x'' = -x every odd coefficient vanishes, where it passes zero every even one."""
    f, x0 = series_loop(oscillator, order + 1), oscillator.start(x=1.0 - speed, dx=speed).values
    log = f.taylor(0.0, x0, 10.0, np.append(oscillator.parameters, 5.0), 1e-8, 1e-8, 10_000)
    t, x = log[:, 0], log[:, 1]
    assert t[-1] == 10.0 and np.abs(x - (np.cos(t) * (1.0 - speed) + np.sin(t) * speed)).max() < 1e-6
    assert t[1] < 1.3 * np.diff(t)[1:-1].max()


@pytest.fixture(scope="module")
def oscillator():
    """x'' = -x, and y that is held."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=x**2 / 2)
    return sv.derive(mechanism, sv.Program({"held": y}, by="ideal"), keep=["x"])


@pytest.mark.parametrize("name", ["appell-hamel", "wheeled-robot"])
@pytest.mark.parametrize("span", [(0.0, 0.5), (0.5, 0.0)])
def test_compiled_and_interpreted_steps_are_the_same(name, span, gallery_model, c_compiler):
    scene, model = gallery[name], gallery_model(name)
    start = model.start(t=span[0], **scene.start, guess=scene.guess)
    f, top = series_loop(model, 11), model.reduction.top
    p = np.append(model.parameters, 0.25)
    log = f.taylor(span[0], start.values, span[1], p, 1e-7, 1e-9, 100)
    f._place(f._interpreter, span[0], start.values, p)
    again = f._interpreter.taylor(span[1], 1e-7, 1e-9, 0, 100)
    n_x = len(start.values)
    np.testing.assert_allclose(again[:, : 1 + n_x], log[:, : 1 + n_x], rtol=1e-11, atol=1e-11)
    t = np.linspace(*span, 41)
    k = np.clip(np.searchsorted(abs(log[:, 0] - span[0]), abs(t - span[0]), "right") - 1, 0, len(log) - 2)
    z, other = f.jets(log, k, t, p, top + 2), np.empty((model.nq + (top + 2) * model.n, 41))
    f._interpreter.jets(log, k, t, p, (top + 2, n_x), other)
    np.testing.assert_allclose(z, other, rtol=1e-12, atol=1e-12 * np.abs(other).max())
    ends = f.jets(log, np.arange(len(log) - 1), log[1:, 0], p, top - 1)
    np.testing.assert_allclose(ends, log[1:, 1 : 1 + n_x].T, rtol=1e-12, atol=1e-12)


def test_the_accuracy_of_steps_follows_the_tolerance(gallery_model):
    """Errors at the end, relative to the state: at most the tolerance on these scenes, and not a millionth of it."""
    for name in ("appell-hamel", "wheeled-robot"):
        scene, model = gallery[name], gallery_model(name)
        start = model.start(**scene.start, guess=scene.guess)

        def end(rtol, order=None, model=model, start=start):
            method = sv.Taylor(order, rtol=rtol, atol=rtol)
            return simulated(model, start, (0.0, 1.0), method, t_eval=[1.0]).jets[: len(start.values), -1]

        exact = end(1e-15, 20)
        for rtol in (1e-4, 1e-6, 1e-8):
            error = np.abs(end(rtol) - exact).max() / max(1.0, np.abs(exact).max())
            assert 1e-6 * rtol < error < rtol
