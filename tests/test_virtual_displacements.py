"""Eq. (3.18) on every gallery system: no work, equivalence with multipliers, regular rows without false symbols."""

import casadi as ca
import numpy as np
import pytest

from servoctl.gallery import gallery
from servoctl.reduction.manifold import sample
from servoctl.reduction.ranks import clean


def virtual_displacements(realisation):
    """Tᵀ, (n - b, n) SX, from the rows of (3.18) of a symbolic balance."""
    r = ca.SX.sym("r", realisation.B.shape[0])
    rows, _ = realisation.dynamics(r)
    return ca.jacobian(ca.vertcat(*rows.values()), r)


@pytest.fixture(scope="module")
def points_of(gallery_model):
    """Points on the manifold of a gallery model's motion that hold accelerations, too."""
    found = {}

    def points(name):
        if name not in found:
            r = gallery_model(name).reduction
            found[name] = sample(r.mechanism.q, r.rows, max(r.top, 2), r.context, starts=r.points)
        assert len(found[name].t) >= 3
        return found[name]

    return points


@pytest.mark.parametrize("name", gallery)
def test_the_virtual_displacements_do_no_work(name, gallery_model, points_of):
    r = gallery_model(name).reduction
    T = virtual_displacements(r.realisation)
    n, b = r.mechanism.q.n, r.realisation.B.shape[1]
    assert T.shape == (n - b, n)
    points = points_of(name)
    work, sizes = points.matrix(T @ r.realisation.B)
    assert np.all(np.abs(work) <= 1e-14 * np.maximum(sizes, 1e-300))
    values, _ = points.matrix(T)
    for p in range(values.shape[2]):
        assert np.linalg.matrix_rank(values[:, :, p].astype(float)) == n - b


@pytest.mark.parametrize("name", gallery)
def test_rows_of_3_18_vanish_iff_multipliers_exist(name, gallery_model, points_of):
    """Tᵀr = Tᵀ N Nᵀr with TᵀN regular, N a numerical null space of Bᵀ, at arbitrary jets; on the motion r = B μ."""
    model = gallery_model(name)
    r = model.reduction
    n, b = r.mechanism.q.n, r.realisation.B.shape[1]
    T, on = virtual_displacements(r.realisation), points_of(name)
    shift = 0.3 * np.random.default_rng(77).uniform(-1.0, 1.0, on.z.shape)
    off = type(on)(on.q, on.t, on.z + shift, on.parameters, on.values, on.residual)
    for points in (on, off):
        t, B, balance = (points.matrix(e)[0].astype(float) for e in (T, r.realisation.B, r.mechanism.balance))
        for p in range(t.shape[2]):
            Tt, reaction, rest = t[:, :, p], B[:, :, p], balance[:, 0, p]
            null, scale = np.linalg.svd(reaction.T)[2][b:].T, np.abs(rest).max() + 1.0
            allowed = 1e-11 * scale * np.abs(Tt).max(initial=1)
            assert Tt @ rest == pytest.approx(Tt @ null @ (null.T @ rest), abs=allowed)
            assert n == b or np.linalg.cond(Tt @ null) < 1e8
            if points is on:
                mu = np.linalg.lstsq(reaction, rest, rcond=None)[0]
                assert reaction @ mu == pytest.approx(rest, abs=1e-10 * scale)


@pytest.mark.parametrize("name", gallery)
def test_multipliers_give_the_balance_and_actuators_supply_it(name, gallery_model, points_of):
    r, points = gallery_model(name).reduction, points_of(name)
    balance, sizes = points.matrix(r.mechanism.balance)
    allowed = 1e-12 * (sizes[:, 0] + np.abs(balance[:, 0]).max())
    wishes = ca.vertcat(*(r.program.toward.get(name, 0.0) for name in r.mechanism.actuators))
    wished = r.mechanism.E @ wishes if r.program.toward else 0.0
    reaction, _ = points.matrix(r.realisation.B @ r.multipliers + wished)
    assert np.all(np.abs(reaction - balance)[:, 0] <= allowed)
    k = len(r.program.residuals)
    supplied = r.mechanism.E @ r.actuation if r.program.by == "actuators" else r.actuation
    if r.mechanism.constraints:
        supplied += r.realisation.B[:, k:] @ r.multipliers[k:]
    supplied, _ = points.matrix(supplied)
    assert np.all(np.abs(supplied - balance)[:, 0] <= allowed)


@pytest.mark.parametrize("name", gallery)
def test_final_rows_are_regular_and_vanish_at_every_level(name, gallery_model, points_of):
    r, points = gallery_model(name).reduction, points_of(name)
    q = r.mechanism.q
    assert len(r.rows) == q.n == r.rank.rank and r.rank.clear and r.rank.kept > 1e-6
    assert r.free == sum(row.order for row in r.rows) + q.nq - q.n - len(q.invariants) and r.top >= 2
    assert set(r.original) == {*r.program.residuals, *r.mechanism.constraints}
    for row in (*r.rows, *r.original.values()):
        for level in q.derivatives([row.expression], max(0, r.top - row.order)):
            values, sizes = points.evaluate(level)
            assert np.all(np.abs(values) <= 1e-12 * np.maximum(sizes, 1e-12)), row.name


@pytest.mark.parametrize("name", gallery)
def test_rows_hold_no_false_symbols(name, gallery_model, points_of):
    """Each row depends on the level of its order, at the points, and names no level above."""
    r, points = gallery_model(name).reduction, points_of(name)
    for row in r.rows:
        assert r.mechanism.q.order(row.expression) <= row.order
        assert np.any(clean(*points.matrix(row.gradient(r.mechanism.q))))


@pytest.mark.parametrize("name", gallery)
def test_hidden_rows_say_what_was_combined_and_lower_the_orders(name, gallery_model):
    r = gallery_model(name).reduction
    of_balances = max(2, r.mechanism.q.order(virtual_displacements(r.realisation)))
    start = sum(row.order for row in r.original.values()) + of_balances * (r.mechanism.q.n - len(r.original))
    assert sum(row.order for row in r.rows) <= start - len(r.hidden)
    assert all(" with " in row.derivation for row in r.hidden)
