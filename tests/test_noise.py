"""Noise by counter: published words, NumPy's words, normal numbers, and the same ones wherever they are drawn."""

import ctypes

import numpy as np
import pytest
from scenes import CRANE
from scipy import stats

import servoctl as sv
from servoctl.codegen import compiler, emit
from servoctl.control import batch, noise
from servoctl.study.cases import CASES, generator
from servoctl.study.close_many import SEEDS

COUNT = 1_000_000
compiled = pytest.mark.skipif(compiler.compiler() is None, reason="needs a compiler")

WORDS = {  # key and counter; the words of the first are a known answer of Random123
    "zeros": ([0, 0], [0, 0, 0]),
    "ones": ([2**64 - 1, 2**64 - 1], [2**64 - 1, 2**64 - 1, 2**64 - 1]),
    "others": ([7, 2**63], [123456789, 2**40 + 3, 1]),
}
KNOWN = "16554d9eca36314c db20fe9d672d0fdc d7e772cee186176b 7e68b68aec7ba23b"


def by_numpy(key, counter):
    """NumPy counts on before it draws."""
    before = (sum(word << (64 * i) for i, word in enumerate(counter)) - 1) % 2**256
    return np.random.Philox(key=sum(word << (64 * i) for i, word in enumerate(key)), counter=before).random_raw(4)


@compiled
@pytest.mark.parametrize("name", WORDS)
def test_words_are_those_of_numpy_and_the_known_ones(name):
    key, counter = WORDS[name]
    text = emit.unit({"NAME": "words"}) + emit.include("normal.h") + (
        "void all(const uint64_t *k, const uint64_t *c, uint64_t *y) { philox(k, c[0], c[1], c[2], y); }\n"
    )
    y = np.empty(4, dtype=np.uint64)
    arrays = [np.array(values, dtype=np.uint64) for values in (key, counter)]
    compiler.library(text, level="-O3").all(*(ctypes.c_void_p(a.ctypes.data) for a in (*arrays, y)))
    assert np.array_equal(y, by_numpy(key, counter))
    assert (" ".join(f"{int(word):016x}" for word in y) == KNOWN) == (name == "zeros")


def test_numbers_are_normal_and_independent():
    y = np.stack([noise.normal(seed, COUNT, [0, 1]) for seed in (11, 12)]).transpose(0, 2, 1).reshape(4, COUNT)
    bins = stats.norm.ppf(np.linspace(0, 1, 1001))
    for row in y:
        moments = [np.mean(row**k) for k in (1, 2, 3, 4)]
        errors = np.sqrt(np.array([1, 2, 15, 96]) / COUNT)
        assert np.all(np.abs(np.array(moments) - [0, 1, 0, 3]) < 5 * errors)
        assert stats.chisquare(np.histogram(row, bins)[0]).pvalue > 1e-4
        beyond = np.sum(np.abs(row) > 4.5)
        assert abs(beyond - COUNT * 2 * stats.norm.sf(4.5)) < 5 * np.sqrt(COUNT * 2 * stats.norm.sf(4.5)) + 1
    lagged = np.vstack([y, *(np.roll(y[:1], lag, axis=1) for lag in (1, 2, 3, 4))])
    for of in (lagged, lagged**2):  # Box and Muller's pairs have a common radius
        correlation = np.corrcoef(of) - np.eye(len(of))
        assert np.abs(correlation).max() < 5.5 / np.sqrt(COUNT)


def test_a_channel_does_not_depend_on_others_nor_on_the_number_of_samples():
    measures = ("x", "l", "theta")
    one, both = sv.Sensors(noise={"theta": 2.0}, seed=4), sv.Sensors(noise={"x": 1.0, "theta": 2.0}, seed=4)
    few, many = one.noisy(measures, 7), both.noisy(measures, 1000)
    assert np.array_equal(few[:, 2], many[:7, 2]) and not np.any(few[:, :2]) and np.all(many[:, 0])
    assert sv.Sensors().noisy(measures, 7) is None


def test_seeds_of_cases_are_those_of_a_sweep(monkeypatch):
    expected = [int(generator(9, i).integers(SEEDS)) for i in range(50)]
    words = [noise.first_words(9, CASES, 50)]
    monkeypatch.setattr(noise, "_library", lambda _: None)
    words += [noise.first_words(9, CASES, 50)]
    for of_cases in words:
        assert (of_cases % 2**32 * SEEDS // 2**32).tolist() == expected


@compiled
@pytest.mark.parametrize("n", [1, 8])
def test_lanes_measure_what_one_loop_measures(plan, monkeypatch, n):
    """By a law that commands its noisy measurement, whose mean square is then that of the input."""
    monkeypatch.setattr(batch, "lanes", lambda: n)
    plant = sv.plant(CRANE)
    law = sv.pd(plan, plant, rate=100.0, kp={"trolley": 1e3, "hoist": 1e3}, kd={"trolley": 50.0, "hoist": 50.0})
    sensors = sv.Sensors(noise={"x": 1e-2, "dl": 1e-3}, quantisation={"x": 1e-5}, seed=2)
    one = sv.close(plant, law, plan.state(0.0), (0.0, 0.5), sensors=sensors)
    many = sv.close_many(one, {"m_load": np.full(19, 100.0)}, record=["trolley", "hoist"], executor=2)
    for i in (0, 7, 18):
        own = sv.Sensors(noise=sensors.noise, quantisation=sensors.quantisation, seed=int(many["seed"][i]))
        alone = sv.close(plant, law, plan.state(0.0), (0.0, 0.5), sensors=own)
        for name in ("trolley", "hoist"):
            assert many.trace[name][:, i] == pytest.approx(alone.input[name], rel=1e-10, abs=1e-8)
    assert np.corrcoef(many.trace["trolley"][:, :19].T)[0, 1:].max() < 0.9
