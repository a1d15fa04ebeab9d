"""Samples of a motion while it is computed: one array from the first to the last."""

import numpy as np
import pytest
from scipy.integrate import DenseOutput

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.methods.motion import Motion
from servoctl.model.variants import place_of, variant_at


def added(room, pieces):
    """A motion of pieces (model, t), whose jets are (t, number of the piece)."""
    motion = Motion(room=room)
    for i, (model, t) in enumerate(pieces):
        t = np.array(t, dtype=float)
        motion.add(model, t, t[None], np.full((1, len(t)), float(i)))
    return motion


@pytest.mark.parametrize("room", [0, 4, 7, 100])
def test_an_instant_that_pieces_share_is_one_sample(room):
    motion = added(room, [("a", [0, 1, 2]), ("a", [2, 3, 3, 4]), ("b", [4]), ("b", [4, 5]), ("b", []), ("a", [5, 6])])
    assert motion.t.tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert motion.jets.tolist() == [[0, 1, 2, 3, 4, 5, 6], [0, 0, 0, 1, 1, 3, 5]]
    assert motion.variants() == [(0, 5, "a"), (5, 6, "b"), (6, 7, "a")]
    assert [(model, t.tolist()) for model, t, _ in motion.by_piece()] == [
        ("a", [0, 1, 2]), ("a", [3, 4]), ("b", [5]), ("a", [6])]  # fmt: skip
    assert [motion.t[first:end].tolist() for _, first, _, end in motion.pieces] == [[0, 1, 2], [2, 3, 4], [4, 5], [5, 6]]


@pytest.mark.parametrize("end, left", [(4.0, [0, 1, 2, 3]), (3.0, [0, 1, 2]), (2.0, [0, 1]), (0.0, [])])
def test_a_motion_is_cut_before_an_instant(end, left):
    motion = added(5, [("a", [0, 1, 2]), ("b", [2, 3, 4])])
    motion.end_before(end, "why")
    assert motion.t.tolist() == left and motion.stop == "why" and motion.jets.shape[1] == len(left)
    assert motion.variants() == [(0, min(3, len(left)), "a"), (3, len(left), "b")][: (len(left) > 0) + (len(left) > 3)]


@pytest.mark.parametrize("method", [None, "Taylor", "RadauIIA", sv.methods.RungeKutta(4, step=3e-4)], ids=str)
def test_samples_are_not_copied_when_a_motion_ends(method, wheel, gallery_model, monkeypatch):
    """Also many of them, so that who interrupts a long motion does not wait."""
    model, start = wheel
    if method is None:
        model = gallery_model("overhead-crane")
        start = model.start()
    reserved, reserve = [], Motion._reserve
    monkeypatch.setattr(Motion, "_reserve", lambda self, *given: reserved.append(given[0]) or reserve(self, *given))
    run = sv.simulate(model, start, (0.0, 1.0), method)
    in_one_call = method in (None, "Taylor")  # whose samples are an array of their own
    assert reserved == ([] if in_one_call else [len(run.t)]) and run.jets.flags.c_contiguous


@pytest.mark.parametrize("end", [1.4, 3.9])
def test_fixed_steps_end_at_the_end_of_the_span_and_at_knots(end):
    """140 steps of (1.4 s)/140 are 1.4000000000000001 s."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)))
    path = q.references(p=sv.paths.rest_to_rest(0.0, 1.0, t_start=0.7, duration=2.1)).p
    model = sv.derive(mechanism, sv.Program({"p": q.dt(y + x / 2 - path)}, by="ideal"))
    run = sv.simulate(model, model.start(x=0.0, y=0.0, dx=0.0), (0.0, end), sv.methods.RungeKutta(4, step=0.01))
    assert run.t[-1] == end and np.all(np.diff(run.t) > 0.009)
    assert {knot for knot in run.knots if knot < end} <= {*run.t}


def test_motions_from_one_start_derive_their_variants_once(monkeypatch):
    from servoctl.gallery import gallery
    from servoctl.model.model import Model
    from servoctl.model.variants import MOST_VARIANTS

    scene = gallery["spiral"]
    model = sv.derive(*scene.build())
    derived, places = Model._of, []
    monkeypatch.setattr(Model, "_of", lambda cls, *given: places.append(given[3]) or derived(*given))
    start = model.start(guess=scene.guess, **scene.start)
    runs = [sv.simulate(model, start, scene.t_span, sv.methods.RungeKutta(4, step=1e-2)) for _ in range(2)]
    assert len(places) == 1 <= runs[0].counters["pivot_changes"]  # which the start has derived
    assert np.array_equal(*(run.jets for run in runs))
    assert runs[0].variants[-1][2] is runs[1].variants[-1][2]
    place = place_of(runs[0].variants[-1][2])
    for k in range(MOST_VARIANTS):
        variant_at(model, (1e-3 * (k + 1), *place[1:]))
    assert variant_at(model, place) is not runs[0].variants[-1][2] and variant_at(model, place) == runs[0].variants[-1][2]


@pytest.mark.parametrize("method", ["RK45", "DOP853", "LSODA"])  # Radau's own steps begin by it, too
def test_the_dense_output_of_a_step_is_evaluated_once(method, gallery_model, monkeypatch):
    model, scene, counted = gallery_model("acrobot"), gallery["acrobot"], []
    start, evaluated = model.start(**scene.start, guess=scene.guess), DenseOutput.__call__
    monkeypatch.setattr(DenseOutput, "__call__", lambda self, t: counted.append(t) or evaluated(self, t))
    run = sv.simulate(model, start, (0.0, 2.0), method)
    assert len(counted) >= run.counters["steps"] > 0
    assert len(counted) <= run.counters["steps"] + 16  # of steps that were taken again
    times = np.linspace(0.0, 2.0, 77)
    before = len(counted)
    run.at(times)
    assert len(counted) == before
