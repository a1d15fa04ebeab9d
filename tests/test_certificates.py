"""Certificates that the motion of every mechanism under every program passes, whatever method and drift treatment."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from scenes import CERTIFIED, KINDS

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods.choice import as_method
from servoctl.model.equations import leading_names

STOPS = {"appell-hamel-squared": 0.6983110523, "constant-speed-horizontal": 5.0 / 9.81}  # s: the others reach their end
INTEGRATED = ("crane-3d-redundant", "mass-on-car", "spiral", "appell-hamel-squared")
METHODS = [  # what integration leaves in hidden rows shows in the accelerations: tolerances are tight
    ("DOP853", None), ("DOP853", "project"), ("DOP853", 0.1), ("RK4", None), ("RK4", "project"), ("RK4", 0.1),
]  # fmt: skip
CASES = [
    *((name, *method) for name in INTEGRATED for method in METHODS),
    *((name, "DOP853", "project") for name in KINDS),
    *((name, "algebraic", None) for name in ("overhead-crane", "winch-crane-redundant")),
    *((name, "Taylor", "project") for name in ("appell-hamel", "two-cars", "passive-arm", "constant-speed")),
]


@pytest.fixture(scope="module")
def scene_run(gallery_model):
    """A function from a scene, a method and a drift treatment to the model and the run, up to its stop."""
    runs = {}

    def run(name, method=None, drift=None):
        if (name, method, drift) not in runs:
            runs[name, method, drift] = _simulated(gallery_model(name), gallery[name], method, drift)
        return runs[name, method, drift]

    return run


def _simulated(model, scene, method, drift):
    t0, t1 = scene.t_span
    start = model.start(**scene.start, guess=scene.guess)
    t_eval = np.linspace(t0, t1, 101) if method not in (None, "RK4") else None
    if method == "RK4":
        method = sv.methods.RungeKutta(4, step=(t1 - t0) / 4000)
    elif method in ("DOP853", "Taylor"):
        method = as_method(method, rtol=1e-12, atol=1e-13)
    try:
        return model, sv.simulate(model, start, scene.t_span, method, drift=drift, t_eval=t_eval)
    except sv.errors.SingularProgram as error:
        return model, error.run


def null_space(matrix):
    """An orthonormal basis of the kernel of a matrix of full row rank, rows of any units."""
    rows = matrix / np.maximum(np.linalg.norm(matrix, axis=1), 1e-300)[:, None]
    return np.linalg.svd(rows)[2][len(matrix) :].T


def worst_of_3_18(run):
    """Largest |Tᵀr| relative to the largest |r|, T from the kernel of the reaction's directions, at 60 samples."""
    worst, balance = 0.0, run.signals("balance")[1]
    for k in np.unique(np.linspace(0, len(run.t) - 1, 60).astype(int)):
        model = run.variant(k)
        n, jets = model.n, run.jets[:, k]
        x = jets[: len(model.state_names)]
        matrices = model.function("matrices")(run.t[k], x, model.p)
        rows = len(leading_names(model.reduction)[0])
        T = null_space(matrices[rows * n : -n].reshape(n, -1).T)
        worst = max(worst, np.abs(T.T @ balance[:, k]).max(initial=0.0))
    return worst / np.abs(balance).max()


def before(run, t):
    """The samples before an instant."""
    n = int(np.sum(run.t < t))
    variants = tuple((first, min(end, n), model) for first, end, model in run.variants if first < n)
    return replace(run, t=run.t[:n], jets=run.jets[:, :n], variants=variants, stored={}, stored_residual={})


@pytest.mark.parametrize(("name", "method", "drift"), CASES)
def test_motions_pass(name, method, drift, scene_run):
    model, run = scene_run(name, method, drift)
    proof = sv.verify(run, segments=3)
    if name in STOPS:
        assert STOPS[name] - 0.05 < run.t[-1] < STOPS[name] + 1e-2 and not run.success
        proof = sv.verify(before(run, STOPS[name] - 0.02), segments=3)
    else:
        assert run.success
    by_poles = method == "RK4" and drift is not None and drift != "project"
    assert proof.numbers["balance"] <= (1e-6 if by_poles else 1e-9)
    assert proof.passed or by_poles
    assert worst_of_3_18(run) <= (1e-6 if by_poles else 1e-9)


@pytest.mark.parametrize("name", [name for name in CERTIFIED if name not in STOPS])
def test_default_runs_pass_in_twenty_restarted_segments(name, scene_run):
    model, run = scene_run(name)
    proof = sv.verify(run)
    assert proof.passed and run.success, proof
    assert proof.numbers["segments"] < 1e-6
    assert "energy" in proof.numbers and proof.numbers["energy"] < 1e-5
    assert len(repr(proof).splitlines()) <= 8 and "passed" in repr(proof)


@pytest.mark.parametrize("name", STOPS)
def test_runs_that_stop_are_told(name, scene_run):
    model, run = scene_run(name)
    proof = sv.verify(run, segments=3)
    assert proof.numbers["balance"] <= 1e-9
    assert any("did not reach its end" in note for note in proof.notes)


@pytest.mark.parametrize("name", ["appell-hamel", "overhead-crane", "winch-crane-redundant", "two-cars-ideal"])
def test_certificates_have_teeth(name, scene_run):
    model, run = scene_run(name)
    k = len(run.t) // 3
    bent = run.jets.copy()
    bent[model.nq + model.n, k] += 1e-6 * np.abs(bent[model.nq + model.n :]).max()  # an acceleration, at one sample
    proof = sv.verify(replace(run, jets=bent, stored={}, stored_residual={}), segments=3)
    assert proof.verdict == "failed" and "FAILED" in repr(proof)  # the balance, or a row where reactions take it up


def test_a_drifted_state_fails(scene_run):
    model, run = scene_run("appell-hamel")
    moved = run.jets.copy()
    moved[2] += 1e-3  # z off the string
    proof = sv.verify(replace(run, jets=moved, stored={}, stored_residual={}), segments=3)
    assert "residual string" in proof.failures


def test_higher_jets_excuse_no_residual(gallery_model):
    model, scene = gallery_model("appell-hamel"), gallery["appell-hamel"]
    start = model.start(**scene.start, guess=scene.guess)
    run = sv.simulate(model, start, (0.0, 0.1), method=sv.methods.Taylor(jets=12))
    moved = run.jets.copy()
    moved[2] += 1e-5  # z off the string
    short = moved[: len(model.jet_names)]
    found = [
        sv.verify(replace(run, jets=jets, jet_names=names, stored={}, stored_residual={}), segments=1)
        for jets, names in ((moved, run.jet_names), (short, model.jet_names))
    ]
    assert np.abs(moved).max() > 100 * np.abs(short).max()
    assert found[0].numbers["residual string"] == found[1].numbers["residual string"] > 1e-6
    assert all("residual string" in proof.failures for proof in found)


def test_every_number_has_its_limit_beside_it(scene_run):
    model, run = scene_run("appell-hamel")
    moved = run.jets.copy()
    moved[2] += 1e-3
    text = repr(sv.verify(replace(run, jets=moved, stored={}, stored_residual={}), segments=3))
    assert "limit 1.0e-06: largest residual, derivatives included (string)  FAILED" in text
    lines = repr(sv.verify(run, segments=3)).splitlines()
    assert lines[0] == "Verification: passed" and len({line.index(", limit ") for line in lines[1:]}) == 1


@pytest.mark.parametrize("segments", [0, -1, "a", 2.5, True, None, 10_001, 1e300, 2**70, ca.SX.sym("n")], ids=str)
def test_segments_that_check_nothing_are_refused(segments, scene_run):
    with refused(sv.errors.SpecificationError, "segments"):
        sv.verify(scene_run("overhead-crane")[1], segments=segments)


@pytest.mark.parametrize("name", ["two-cars-ideal", "appell-hamel", "constant-speed"])
def test_what_actuators_cannot_give_of_an_ideal_reaction_is_told(name, scene_run):
    model, run = scene_run(name)
    proof = sv.verify(run, segments=3)
    if model.actuators:
        assert proof.numbers["outside"] > 0.1  # the reaction of the program is not in the actuators' reach
    else:
        assert "outside" not in proof.numbers
