"""The servo DAE itself, as the literature integrates it: its residual, and backward Euler and BDF2 on it.

Unknowns are coordinates, velocities and the forces that realise the program; see docs/servo_dae.md.
"""

from time import perf_counter

import casadi as ca
import numpy as np

from servoctl.checks import as_span, positives
from servoctl.codegen.function import compiled
from servoctl.errors import SpecificationError, unknown
from servoctl.figures import style
from servoctl.methods.choice import Taylor
from servoctl.model.variants import derived_near
from servoctl.reduction.ranks import clean, decide_all, eliminate
from servoctl.simulation import consistent_state, simulate
from servoctl.study.table import Study, machine

FORMS = ("servo", "projected")
METHODS = {"BE": 1, "BDF2": 2}
MOST_ITERATIONS, CLOSE = 15, 1e-6  # of Newton's method; what its last change of q may be relative to 1 + |q|
MOST_STEPS = 10**7  # each is a Newton iteration in Python
LAYER = 10  # steps at the start that are left out: formulas of order p need index + p of them to forget it
TRUNCATED, ROUNDED = 3.0, 3.0  # a step belongs to a branch of the error where it is that much above the minimum



def servo_dae(model, form):
    """Residual and Jacobian of one implicit step on the servo DAE, as a compiled function of the model.

    Unknowns are z = (q, γ', μ) with the multipliers μ of the reaction B μ: the inputs u where actuators realise the
    program without redundancy. Rates are those of a linear multistep formula, q̇ = α q + s_q and γ̈ = α γ' + s_γ.

    "servo" is the DAE as it stands, q̇ = V γ' + h, r(t, q, γ', γ̈) = B μ, φ = 0: of index 5 where the essential order
    is 4. "projected" is that of Blajer and Kołodziejczyk (2004), of lower index: the balance on ker C only, and
    φ̈ = 0 with the accelerations of the plant, C M⁻¹(B μ - r₀) + ξ = 0, beside φ = 0.

    Parameters
    ----------
    model : Model
    form : {"servo", "projected"}

    Returns
    -------
    Compiled
        Of t, z (nq + n + b) and (p, α, s_q, s_γ); outputs the residual and its Jacobian in z, column by column.

    Raises
    ------
    SpecificationError
        If a residual holds derivatives above velocities: such a program is no DAE in these unknowns.
    """
    name = f"servo_dae_{form}"
    return model.once(name, lambda: compiled(_step(model.equations, form, name), name))


def _step(equations, form, name):
    r, q = equations.r, equations.q
    rows = list(r.original.values())
    high = [row.name for row in rows if row.order > 1]
    if high:
        raise SpecificationError(
            f"The program's {', '.join(high)} holds derivatives of order 2 or higher.",
            "The servo DAE has coordinates, velocities and forces as unknowns.",
            do="Give a program on coordinates and velocities, or compare methods by tradeoff(...).",
            rows=high,
        )
    B = r.realisation.B
    velocity, acceleration = ca.vertcat(*q.gamma(1)), ca.vertcat(*q.gamma(2))
    mu, alpha = ca.SX.sym("mu", B.shape[1]), ca.SX.sym("alpha")
    past_q, past_v = ca.SX.sym("past_q", q.nq), ca.SX.sym("past_v", q.n)
    balance = _projected(equations, rows, mu) if form == "projected" else r.mechanism.balance - B @ mu
    moving = alpha * ca.vertcat(*q) + past_q - q.V @ velocity - q.h
    residual = ca.vertcat(moving, balance, *(row.expression for row in rows))
    residual = ca.substitute(residual, acceleration, alpha * velocity + past_v)
    z = ca.vertcat(*q, velocity, mu)
    jacobian = ca.vec(ca.densify(ca.jacobian(residual, z)))
    return equations.function(name, z, [residual, jacobian], ca.vertcat(alpha, past_q, past_v))


def _projected(equations, rows, mu):
    """Dᵀ(r - B μ) with C D = 0, and φ̈ with the accelerations of the plant."""
    r, q = equations.r, equations.q
    acceleration, zero = ca.vertcat(*q.gamma(2)), ca.SX.zeros(q.n)
    second = ca.vertcat(*(q.derivatives([row.expression], 2 - row.order)[-1][0] for row in rows))
    C = ca.jacobian(second, acceleration)
    numbers, sizes = r.points.matrix(C)
    numbers = clean(numbers, sizes)
    dependent = sorted(decide_all(*r.points.matrix(C))[0].columns)
    independent = [i for i in range(q.n) if i not in dependent]
    unbalanced = r.mechanism.balance - r.realisation.B @ mu
    A = eliminate(C[:, dependent], -C[:, independent], numbers[:, dependent])[0]
    free = unbalanced[independent] + A.T @ unbalanced[dependent]
    mass = r.mechanism.mass
    force = -ca.substitute(unbalanced, acceleration, zero)
    plant = eliminate(mass, force, clean(*r.points.matrix(mass)))[0]
    return ca.vertcat(free, ca.substitute(second, acceleration, plant))


class DaeComparison(Study):
    """Errors of implicit steps on the servo DAE over the step; made by `dae_comparison`.

    Columns: form, method, step [s], steps, motion and force (relative errors), iterations (of Newton's method, per
    step), seconds, message (empty unless the iteration failed).
    """

    def best(self, form, method="BE"):
        """The step with the least error of the force, and the slopes on both sides of it.

        Parameters
        ----------
        form : {"servo", "projected"}
        method : {"BE", "BDF2"}

        Returns
        -------
        dict of str to float
            "step" [s], "force" and "motion" (errors measured there); "order" p and "rounding" r of the fit
            C hᵖ + ε/hʳ, and "fitted_step" [s], which minimises it. NaN where the steps do not reach that far.

        Raises
        ------
        NameUnknown
            If there is no such row.
        """
        for name, value in (("form", form), ("method", method)):
            if value not in self[name]:
                raise unknown(value, dict.fromkeys(self[name].tolist()), name)
        rows = self.where(form=form, method=method)
        rows = rows.take(np.flatnonzero(np.isfinite(rows["force"])))
        if not len(rows):
            return dict.fromkeys(("step", "force", "motion", "order", "rounding", "fitted_step"), np.nan)
        h, error = rows["step"], rows["force"]
        i = int(np.argmin(error))
        p, C = _branch(h, error, (h > h[i]) & (error > TRUNCATED * error[i]) & (error < 0.3))
        slope, rounding = _branch(h, error, (h < h[i]) & (error > ROUNDED * error[i]))
        r = -slope
        least = (r * rounding / (p * C)) ** (1 / (p + r)) if p > 0 and r > 0 else np.nan
        measured = {"step": h[i], "force": error[i], "motion": rows["motion"][i]}
        return {k: float(v) for k, v in (measured | {"order": p, "rounding": r, "fitted_step": least}).items()}

    def plot(self):
        """Draw the errors of motion and force over the step.

        Returns
        -------
        matplotlib.figure.Figure
        """
        figure, (panels,) = style.figure(4.2, columns=2, sharex=True)
        for ax, name in zip(panels, ("motion", "force"), strict=True):
            for colour, form in zip(style.COLOURS, FORMS, strict=False):
                for mark, method in zip(("o-", "s--"), METHODS, strict=True):
                    rows = self.where(form=form, method=method)
                    if len(rows):
                        label = f"{method}, {form} form" + (" (index as it is)" if form == "servo" else "")
                        ax.loglog(rows["step"], rows[name], mark, color=colour, markersize=4, label=label)
            ax.set(xlabel="step h [s]", ylabel=f"relative error of the {name}")
            ax.grid(alpha=0.3)
        figure.axes[0].legend(fontsize=9)
        return figure


def dae_comparison(model, start, t_span, steps=None, forms=tuple(FORMS), methods=tuple(METHODS)):
    """Integrate the servo DAE by implicit steps of fixed length, and compare with the model's own solution.

    Parameters
    ----------
    model : Model
    start : State or (n_x,) array
        From `model.start`.
    t_span : (t0, t1)
        [s]
    steps : sequence of float, optional
        Steps [s], each rounded so that a whole number of them fills the span. Default: a twentieth of the span,
        halved eleven times.
    forms : sequence of {"servo", "projected"}
        The servo DAE as it stands, and Blajer's projected form of lower index.
    methods : sequence of {"BE", "BDF2"}
        Backward Euler, and the two-step formula of order 2 begun by it.

    Returns
    -------
    DaeComparison

    Raises
    ------
    NameUnknown
        For another form or method.
    InconsistentStart
        For a start off the constraints.
    SpecificationError
        If a step is not positive, or the program holds derivatives above velocities.

    Notes
    -----
    Each step is solved by Newton's method with the exact Jacobian until rounding stops it. The constraint is met to
    rounding ε, and each of the r differentiations that the force needs divides by h: its error is C hᵖ + ε/hʳ, with a
    step of least error that no tolerance improves.
    """
    forms, methods = ([names] if isinstance(names, str) else names for names in (forms, methods))
    t0, t1 = as_span(t_span, forward=True)
    steps = _steps(t0, t1, steps)
    _require_known(forms, methods)
    consistent_state(model, start, t0)
    rows = []
    for step in steps:
        count = max(2, round((t1 - t0) / step))
        t = np.linspace(t0, t1, count + 1)
        reference, first = _reference(model, start, t)
        for form in forms:
            for method in methods:
                rows.append({"form": form, "method": method, **_integrated(model, form, method, t, reference, first)})
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    meta = {"t_span": [float(t0), float(t1)], "index": str(model.structure().index), "machine": machine()}
    study = DaeComparison("daecomparison", columns, meta)
    meta["best"] = {f"{form} {method}": study.best(form, method) for form in forms for method in methods}
    parts = (f"{name}: h = {b['step']:.2g} s, error {b['force']:.1e}" for name, b in meta["best"].items())
    meta["message"] = "least error of the force: " + "; ".join(parts)
    return study


def _require_known(forms, methods):
    for names, known, what in ((forms, FORMS, "form"), (methods, METHODS, "method")):
        for name in names:
            if name not in known:
                raise unknown(name, known, what)
    if not (len(forms) and len(methods)):
        raise SpecificationError(
            f"forms={forms!r} and methods={methods!r} were given.",
            "A comparison needs at least one of each.",
            do="Leave them out to compare all.",
            forms=forms,
            methods=methods,
        )


def _steps(t0, t1, steps):
    """Steps as an array of positive lengths, the default ones where none are given."""
    length = t1 - t0
    if steps is None:
        return length / 20.0 / 2.0 ** np.arange(12)
    steps = np.ravel(positives("steps", steps, f"Give steps such as {length / 20:g} s.", most=length))
    if steps.min() <= length / MOST_STEPS:
        raise SpecificationError(
            f"steps={steps!r} were given over {t0:g} .. {t1:g} s.",
            f"At most {MOST_STEPS:,} steps may fill the span.",
            nearest=f"{length / MOST_STEPS:.2g} s.",
            steps=steps,
        )
    return steps


def _reference(model, start, t):
    """(q, γ', μ) of the model's own solution, (nq + n + b, N), and all jets at its start."""
    options = {} if model.flat else {"method": Taylor(rtol=1e-13, atol=1e-14), "drift": "project"}
    run = simulate(model, start, (t[0], t[-1]), t_eval=t, progress=False, **options)
    columns = np.searchsorted(run.t, t - 1e-12 * (t[-1] - t[0]))
    forces = run.signals("all_multipliers")[1]
    return np.vstack([run.jets[: model.nq + model.n], forces])[:, columns], run.jets[: len(model.jet_names), columns[0]]


def _integrated(model, form, method, t, reference, first):
    f = servo_dae(model, form)
    rates = np.zeros(model.nq + model.n)
    if not np.all(np.isfinite(f(t[0], reference[:, 0], np.concatenate([model.p, [1.0], rates])))):
        f = servo_dae(derived_near(model, t[0], first), form)  # pivots of the projection vanish at the start
    began = perf_counter()
    z, iterations = _march(f, model, METHODS[method], t, reference[:, 0])
    seconds = perf_counter() - began
    nq, moving = model.nq, model.nq + model.n
    k = moving + len(model.reduction.program.residuals)
    done = z.shape[1]
    failed = done < len(t)
    after = slice(min(LAYER, (len(t) - 1) // 2), done)
    errors = np.abs(z - reference[:, :done])[:, after]
    sizes = np.abs(reference).max(axis=1)

    def relative(part):
        worst = errors[part].max(axis=1, initial=0.0)
        return np.nan if failed else float((worst / np.where(sizes[part] > 0, sizes[part], 1.0)).max())

    return {
        "step": float(t[1] - t[0]),
        "steps": len(t) - 1,
        "motion": relative(slice(0, nq)),
        "force": relative(slice(moving, k)),
        "iterations": iterations / max(done - 1, 1),
        "seconds": seconds,
        "message": f"Newton's method fails at t = {t[done]:.4g} s" if failed else "",
    }


def _march(f, model, order, t, z0):
    """States (N, M) at the first M times, all of them unless an iteration fails, and the iterations made."""
    moving, h = model.nq + model.n, t[1] - t[0]
    past, z, total = [z0], [z0], 0
    for k in range(1, len(t)):
        if order == 1 or k == 1:
            weights = (1.0, -1.0)
        else:
            weights = (1.5, -2.0, 0.5)
        history = sum(w * x[:moving] for w, x in zip(weights[1:], reversed(past), strict=False)) / h
        p = np.concatenate([model.p, [weights[0] / h], history])
        state, iterations = _newton(f, t[k], z[-1], p, model.nq)
        total += iterations
        if state is None:
            break
        z.append(state)
        past = [*past[-1:], state]
    return np.array(z).T, total


def _newton(f, t, z, p, nq):
    """The solution from a guess, or None, and the iterations made: until the change of q no longer shrinks."""
    n, last = len(z), np.inf
    for iteration in range(1, MOST_ITERATIONS + 1):
        y = f(t, z, p)
        try:
            change = np.linalg.solve(y[n:].reshape(n, n).T, y[:n])
        except np.linalg.LinAlgError:
            return None, iteration
        z = z - change
        size = (np.abs(change[:nq]) / (1.0 + np.abs(z[:nq]))).max()
        if not np.isfinite(size):
            return None, iteration
        if size <= 1e-15 or (iteration > 2 and size > last / 2 and size < CLOSE):
            return z, iteration
        last = size
    return (z if last < CLOSE else None), MOST_ITERATIONS


def _branch(h, error, rows):
    """Slope and factor of error = factor · h^slope on some of the points; NaN for fewer than two."""
    if rows.sum() < 2:
        return np.nan, np.nan
    slope, logarithm = np.polyfit(np.log(h[rows]), np.log(error[rows]), 1)
    return slope, np.exp(logarithm)
