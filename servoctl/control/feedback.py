"""Linear feedback about a reference trajectory: u = u_ff - K (y - y_ref) - K_i z, with residuals integrated in z."""

from typing import NamedTuple

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.control.law import Law


def law_step(name, t, x, column, outputs):
    """The compiled step of a law, (t_k, [y; z], column k) -> [u; z+; signals], with the C function that loops call.

    `t`, `x` and `column` are symbols, `outputs` expressions of them: command, next controller state, further signals.
    """
    y = ca.densify(ca.cse(ca.vertcat(*outputs)))
    return compiled(ca.Function(name, [t, x, column], [y], ["t", "x", "p"], ["y"]), name, ("law",))


def affine_law(measures, n_u, residuals=None):
    """The step u = u_ff - K (y - y_ref) - K_i z,  z+ = z + Ts φ(t, y) of a law.

    y are the measured states; z integrates residuals φ, if there are any. Columns of the schedule are [u_ff; y_ref; K
    row by row; K_i row by row; Ts; parameters of φ], the last three with residuals only.
    """
    n_y, n_z = len(measures), len(residuals.names) if residuals else 0
    t, u_ff = ca.SX.sym("t"), ca.SX.sym("u_ff", n_u)
    y, z, y_ref = ca.SX.sym("y", n_y), ca.SX.sym("z", n_z), ca.SX.sym("y_ref", n_y)
    K, K_i = ca.SX.sym("K", n_y, n_u), ca.SX.sym("K_i", n_z, n_u)
    u = u_ff - K.T @ (y - y_ref) - K_i.T @ z
    further, z_next = integrating(residuals, t, y, measures, z)
    column = ca.vertcat(u_ff, y_ref, ca.vec(K), ca.vec(K_i), *further)
    return law_step("affine", t, ca.vertcat(y, z), column, [u, *z_next])


def integrating(residuals, t, y, measures, z):
    """Ts and the parameters of φ at the end of a column, and z+ = z + Ts φ(t, y); nothing without residuals."""
    if not residuals:
        return [], []
    period, p = ca.SX.sym("Ts"), ca.SX.sym("p", residuals.parameters.size)
    return [period, p], [z + period * residuals.expression(t, y, measures, p)]


class StateFeedback(NamedTuple):
    """Gains on all states of a plant, u = u_ff - K (x - x_ref) - K_i z, for a measured or an estimated state.

    `states` are the names of x, `residuals` those that z integrates; K (N, m, n_x) and K_i (N, m, n_z) by sample.
    """

    states: tuple
    residuals: tuple
    K: np.ndarray
    K_i: np.ndarray


def affine(name, reference, K, K_i=None, residuals=None, info=None):
    """The law u = u_ff - K (x - x_ref) - K_i z along a reference, with K (N, m, n_x) and K_i (N, m, n_z).

    States without gains are not measured. `info` are results of the design.
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
        name=name,
        measures=measures,
        inputs=plant.inputs,
        rate=reference.rate,
        t0=reference.t[0],
        step=affine_law(measures, len(plant.inputs), residuals=residuals),
        schedule=np.vstack(schedule),
        state=np.zeros(len(names)),
        state_names=integral_names(names),
        initial_input=reference.initial_input,
        plan=reference.plan,
        info=info or {},
        integrators=tuple(range(len(names))),
    )


def integration(reference, residuals):
    """The schedule of z+ = z + Ts φ: Ts, the parameters of φ and what is planned at each sample, (1 + n_p, N)."""
    constant = np.append(reference.period, residuals.parameters[: len(residuals.places)])
    along = residuals.along(reference.plan, reference.t)
    planned = [along[name] if name in along else reference.planned(name) for name in residuals.planned]
    return np.vstack([np.tile(constant[:, None], len(reference.t)), *planned, residuals.jets.at(reference.t)])


def integral_names(residuals):
    """Names of the controller states that integrate residuals."""
    return tuple(f"integral of {name}" for name in residuals)
