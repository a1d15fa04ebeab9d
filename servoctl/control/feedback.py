"""Laws of feedback about a reference: u = u_ff - K (y - y_ref) - K_i z, with residuals integrated in z."""

from typing import NamedTuple

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.control.law import Law


def law_step(name, t, x, row, outputs):
    """The compiled step of a law, (t_k, [y; z], row_k) -> [u; z+; signals], with the C function that loops take.

    `t`, `x` and `row` are symbols, `outputs` expressions of them: command, next controller state, further signals.
    """
    y = ca.densify(ca.cse(ca.vertcat(*outputs)))
    return compiled(ca.Function(name, [t, x, row], [y], ["t", "x", "p"], ["y"]), name, ("law",))


def affine_law(measures, n_u, feedback=True, residuals=None):
    """u = u_ff - K (y - y_ref) - K_i z,  z+ = z + Ts φ(t, y).

    y are the measured states, z integrates residuals if there are any; without feedback the law is u_ff alone. Its
    schedule has the columns [u_ff; y_ref; K row by row; K_i row by row; Ts; parameters of φ], as far as needed.
    """
    t, u_ff = ca.SX.sym("t"), ca.SX.sym("u_ff", n_u)
    if not feedback:
        return law_step("feedforward", t, ca.SX.sym("x", 0), u_ff, [u_ff])
    n_y = len(measures)
    n_z = len(residuals.names) if residuals else 0
    y, z, y_ref = ca.SX.sym("y", n_y), ca.SX.sym("z", n_z), ca.SX.sym("y_ref", n_y)
    K, K_i = ca.SX.sym("K", n_y, n_u), ca.SX.sym("K_i", n_z, n_u)
    u = u_ff - K.T @ (y - y_ref) - K_i.T @ z
    row = [u_ff, y_ref, ca.vec(K), ca.vec(K_i)]
    if not n_z:
        return law_step("affine", t, y, ca.vertcat(*row), [u])
    period, p = ca.SX.sym("Ts"), ca.SX.sym("p", residuals.parameters.size)
    phi = residuals.expression(t, y, measures, p)
    return law_step("affine", t, ca.vertcat(y, z), ca.vertcat(*row, period, p), [u, z + period * phi])


class StateFeedback(NamedTuple):
    """Gains on all states of a plant, u = u_ff - K (x - x_ref) - K_i z; what an estimate of x may be fed to.

    Attributes
    ----------
    states : tuple of str
        Names of the plant's states x.
    residuals : tuple of str
        Names of the residuals that z integrates.
    K, K_i : (N, m, n_x), (N, m, n_z) arrays
        By sample.
    """

    states: tuple
    residuals: tuple
    K: np.ndarray
    K_i: np.ndarray


def affine(name, reference, K, K_i=None, residuals=None, info=None):
    """The law u = u_ff - K (x - x_ref) - K_i z of gains along a reference.

    K is (N, m, n_x), K_i (N, m, n_z); states whose gains all vanish are not measured. `info` are facts of the design.
    """
    plant, names = reference.plant, residuals.names if residuals else ()
    used = np.any(K != 0, axis=(0, 1))
    needed = set(residuals.measures) if residuals else set()
    measures = tuple(n for n, u in zip(plant.state_names, used, strict=True) if u or n in needed)
    where = [plant.state_names.index(name) for name in measures]
    schedule = [reference.inputs(), reference.x[where], K[:, :, where].reshape(len(K), -1).T]
    if residuals:
        schedule.append(K_i.reshape(len(K), -1).T)
        schedule.append(integration(reference, residuals))
    return Law(
        name=name, measures=measures, inputs=plant.inputs, rate=reference.rate, t0=reference.t[0],
        step=affine_law(measures, len(plant.inputs), residuals=residuals), schedule=np.vstack(schedule),
        state=np.zeros(len(names)), state_names=integral_names(names), idle=reference.idle, plan=reference.plan,
        info=info or {}, integrators=tuple(range(len(names))),
    )  # fmt: skip


def integration(reference, residuals):
    """What z+ = z + Ts φ takes from the schedule: Ts and the parameters of φ at each sample, (1 + n_p, N)."""
    return np.tile(np.append(reference.period, residuals.parameters)[:, None], len(reference.t))


def integral_names(residuals):
    """Names of the integrals of residuals among the controller state."""
    return tuple(f"integral of {name}" for name in residuals)
