"""From the description of an arm to the function of its accelerations, and what its operations grow with."""

import os
import tempfile
import time
from functools import partial

import arms
import numpy as np
from harness import Limit, Missing, Row, installed
from native import COMPILER

import servoctl as sv
from servoctl.codegen import compiler
from servoctl.gallery import planar_arm
from servoctl.model.saddle import accelerations

PEER = "SymPy: Kane's method, lambdify(cse=True)"
LINKS = 4


def derived(n, coordinates="joints"):
    """The SX function of accelerations and reaction, from nothing."""
    return accelerations(sv.derive(*planar_arm(n, coordinates)).equations)


def compiled(n, coordinates):
    """The same, compiled into an empty cache."""
    compiler._loaded.clear()  # what this process has loaded is not compiled again
    before = os.environ.get("SERVOCTL_CACHE")
    with tempfile.TemporaryDirectory() as cache:
        os.environ["SERVOCTL_CACHE"] = cache
        try:
            f = sv.derive(*planar_arm(n, coordinates)).function("accelerations")
            f.native("point")
        finally:
            os.environ.pop("SERVOCTL_CACHE") if before is None else os.environ.update(SERVOCTL_CACHE=before)
    return f


def sympy_kane(n):
    """Mass matrix, forcing, Jacobian of the end point and its drift; nothing that an earlier call left in the cache."""
    import sympy as sm
    import sympy.physics.mechanics as me

    sm.core.cache.clear_cache()
    q, u = me.dynamicsymbols(f"q:{n}"), me.dynamicsymbols(f"u:{n}")
    m, l, g = sm.symbols("m l g")
    base, joint = me.ReferenceFrame("N"), me.Point("O")
    joint.set_vel(base, 0)
    frame, bodies, loads = base, [], []
    for i in range(n):
        link = frame.orientnew(f"A{i}", "Axis", (q[i], base.z))
        link.set_ang_vel(frame, u[i] * base.z)
        centre, end = joint.locatenew(f"C{i}", l / 2 * link.x), joint.locatenew(f"E{i}", l * link.x)
        centre.v2pt_theory(joint, base, link)
        end.v2pt_theory(joint, base, link)
        bodies.append(me.RigidBody(f"B{i}", centre, link, m, (me.inertia(link, 0, 0, m * l**2 / 12), centre)))
        loads.append((centre, -m * g * base.y))
        frame, joint = link, end
    rates = {q[i].diff(): u[i] for i in range(n)}
    kane = me.KanesMethod(base, q_ind=q, u_ind=u, kd_eqs=[u[i] - q[i].diff() for i in range(n)])
    kane.kanes_equations(bodies, loads)
    speed = joint.vel(base)
    J = sm.Matrix([speed.dot(base.x), speed.dot(base.y)]).jacobian(u)
    drift = J.diff(me.dynamicsymbols._t).xreplace(rates) * sm.Matrix(u)
    return sm.lambdify([q, u, [m, l, g]], [kane.mass_matrix, kane.forcing, J, drift], cse=True)


def numbers(f):
    """Joint accelerations and reaction by what was derived, at one state."""
    q, v = arms.state(LINKS)
    p = list(arms.P.values())
    if hasattr(f, "native"):
        return arms.answer(LINKS, False, f(0.0, np.concatenate([q, v]), p))
    if hasattr(f, "numel_out"):
        return arms.answer(LINKS, False, f(0.0, np.concatenate([q, v]), p).full().ravel())
    M, forcing, J, drift = f(q, v, p)
    matrix = np.block([[M, -J.T], [J, np.zeros((2, 2))]])
    return np.linalg.solve(matrix, np.concatenate([forcing.ravel(), -drift.ravel()]))


def four_links(title, ours, bar):
    exact = arms.answer(LINKS, False, arms.ours(LINKS, False, False, "bodies")())
    peer = partial(sympy_kane, LINKS) if installed("sympy") else Missing("sympy is not installed")

    def error(f):
        return np.abs(numbers(f) - exact).max() / np.abs(exact).max()

    return Row(
        f"Planar arm of 4 links, from description to function: {title}", ours, {PEER: peer}, error, 1e-9, {PEER: bar}
    )


def sixteen_links(rounds):
    """Seconds to derive and compile."""
    samples = []
    for _ in range(rounds):
        start = time.perf_counter()
        compiled(16, "bodies")
        samples.append(time.perf_counter() - start)
    return samples


def growth(coordinates, rounds):
    return [count(32, coordinates) / count(16, coordinates)]


def per_link(coordinates, rounds):
    return [count(32, coordinates) / 32]


def count(n, coordinates):
    return arms.arm(n, False, coordinates)[0].operations


cold = partial(compiled, LINKS, "joints") if COMPILER else Missing("gcc is not installed")
ROWS = {
    "derive-4": partial(four_links, "derived", partial(derived, LINKS), 20),
    "derive-4-cold": partial(four_links, "derived and compiled, empty cache", cold, 2.5),
    "derive-16-cold": partial(
        Limit, "Planar arm of 16 links, derived and compiled, empty cache", sixteen_links, 2.0, "s"
    ),
}
for form, name in (("bodies", "coordinates of each body"), ("joints", "joint angles")):
    suffix = "" if form == "bodies" else "-joints"
    ROWS[f"growth{suffix}"] = partial(
        Limit, f"Operations of the planar arm in {name}: 32 links / 16 links", partial(growth, form), 2.15
    )
    ROWS[f"per-link{suffix}"] = partial(
        Limit, f"Operations per link of the planar arm of 32 links in {name}", partial(per_link, form), 300
    )
