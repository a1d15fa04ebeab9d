"""What a formulation costs: (3.18), which needs no multipliers, against the equations with them.

One motion in several formulations, their operations and times; see docs/formulations.md.
"""

from time import perf_counter

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.errors import SpecificationError, unknown
from servoctl.figures import style
from servoctl.model import saddle
from servoctl.model.model import derive
from servoctl.study.table import Study, machine

NAMES = {
    "eliminated": "(3.18)",
    "sparse": "multipliers, sparse elimination",
    "qr": "multipliers, dense QR (ca.solve)",
    "assembly": "multipliers, dense LU (LAPACK)",
}
POINTS, REPEATED = 300, 5  # states at which accelerations are evaluated, and how often: the least time counts
FEW = 20  # states where nothing is timed: not enough to compile for
SEED = 3


def formulation(model, how, forces=False):
    """γ'' at a state, with the multipliers if `forces`, in one formulation, as a compiled function of the model.

    Parameters
    ----------
    model : Model
    how : {"eliminated", "sparse", "qr", "assembly"}
        (3.18) with the constraints, multipliers afterwards from r_D = B_D μ; the matrix [M -B; G 0] of accelerations
        and multipliers by sparse symbolic elimination; the same matrix by CasADi's `solve`, a dense QR factorisation;
        or that matrix itself, column by column, and its right side, for a dense numerical solution.
    forces : bool
        Whether to compute the multipliers, too.

    Returns
    -------
    Compiled
        Of (t, X, p); outputs γ'', and μ.

    Raises
    ------
    SpecificationError
        If accelerations do not follow from a state.
    """
    name = f"formulation_{how}{'_forces' if forces else ''}"

    def build():
        equations = model.equations
        return compiled(equations.function(name, equations.state, _outputs(equations, how, forces)), name)

    return model.once(name, build)


def _outputs(equations, how, forces):
    r, q = equations.r, equations.q
    if not saddle.applies(r):
        raise SpecificationError(
            f"The program leads to a motion of order {r.top} with {len(r.hidden)} hidden constraints.",
            "Formulations are compared where the balance and the constraints give the accelerations.",
            do="Give a program of order 2 or less without hidden constraints.",
            order=r.top,
            hidden=len(r.hidden),
        )
    acceleration = ca.vertcat(*q.gamma(2))
    if how == "eliminated":
        solution = equations.dense()
        multipliers = ca.substitute(r.multipliers, acceleration, solution) if forces else ca.SX(0, 1)
    elif how == "sparse":
        solution, multipliers, _ = saddle.solve(equations)
    else:
        matrix, right = _multiplier_form(equations)
        if how == "assembly":
            return [ca.vec(ca.densify(matrix)), right]
        both = ca.solve(matrix, right)
        solution, multipliers = both[: q.n], both[q.n :]
    return [solution, multipliers] if forces else [solution]


def _multiplier_form(equations):
    r, q = equations.r, equations.q
    rows = [a for a, row in enumerate(r.rows) if row.kind != "dynamics"]
    acceleration, B = ca.vertcat(*q.gamma(2)), r.realisation.B
    G = ca.jacobian(ca.vertcat(*(equations.levels[a][-1] for a in rows)), acceleration)
    matrix = ca.vertcat(ca.horzcat(r.mechanism.mass, -B), ca.horzcat(G, ca.SX(len(rows), B.shape[1])))
    balance = ca.substitute(r.mechanism.balance, acceleration, ca.SX.zeros(q.n))
    return matrix, -ca.vertcat(balance, *equations.rest(rows))


class FormulationCost(Study):
    """Operations and time of one evaluation of the accelerations; made by `formulation_cost`.

    Columns: n, k, formulation, operations (of γ''), with_forces (of γ'' and the multipliers), microseconds (of γ'', in
    a loop; NaN where it was not timed), difference (of γ'' from the first formulation, relative).
    """

    def table(self):
        """The operations as a table in Markdown: one line for each n and k, a column for each formulation.

        Returns
        -------
        str
        """
        names = list(dict.fromkeys(self["formulation"].tolist()))
        lines = ["| n | k | " + " | ".join(names) + " |", "|---" * (2 + len(names)) + "|"]
        for n, k in dict.fromkeys(zip(self["n"].tolist(), self["k"].tolist(), strict=True)):
            cells = [f"{row['operations']:,} / {row['with_forces']:,}" for row in self.where(n=n, k=k).rows()]
            lines.append(f"| {n} | {k} | " + " | ".join(cells) + " |")
        return "\n".join(lines)

    def plot(self):
        """Draw operations and times over n, for the largest k of each.

        Returns
        -------
        matplotlib.figure.Figure
        """
        figure, (panels,) = style.figure(4.2, columns=2, sharex=True)
        largest = {int(n): int(self.where(n=n)["k"].max()) for n in np.unique(self["n"])}
        rows = [i for i, (n, k) in enumerate(zip(self["n"], self["k"], strict=True)) if k == largest[int(n)]]
        constrained = self.take(rows)
        labels = {"operations": "operations for γ''", "microseconds": "time of one evaluation [µs]"}
        for ax, name in zip(panels, labels, strict=True):
            for i, how in enumerate(dict.fromkeys(constrained["formulation"].tolist())):
                part = constrained.where(formulation=how)
                ax.loglog(part["n"], part[name], "osDv"[i % 4] + "-", label=how)
            ax.set(xlabel="n, with the most constraints k", ylabel=labels[name])
            ax.grid(alpha=0.3)
        figure.axes[0].legend(fontsize=9)
        return figure


def formulation_cost(build, cases, formulations=tuple(NAMES), timed=True):
    """Count and time the accelerations of the same mechanisms in every formulation.

    Parameters
    ----------
    build : callable
        build(n, k) returns (Mechanism, Program); n and k are the family's own sizes.
    cases : sequence of (n, k)
    formulations : sequence of {"eliminated", "sparse", "qr", "assembly"}
        (3.18), and the equations with multipliers by sparse symbolic elimination, by CasADi's `solve`, and assembled
        for LAPACK. The first is the one others are compared with.
    timed : bool
        Whether to compile and time them; operations are counted without.

    Returns
    -------
    FormulationCost

    Raises
    ------
    SpecificationError
        If there is no case, or the accelerations of one do not follow from its state.
    NameUnknown
        For another formulation.

    Notes
    -----
    Operations are those of the compiled functions, the same on every machine. Of the dense LU they are those of the
    assembly and 2N³/3 + 2N² of the solution for N accelerations and multipliers.
    """
    for how in formulations:
        if how not in NAMES:
            raise unknown(how, NAMES, "formulation")
    try:
        pairs = [(int(n), int(k)) for n, k in cases]
    except (TypeError, ValueError):
        pairs = []
    if not (pairs and len(formulations)):
        raise SpecificationError(
            f"cases={cases!r} and formulations={formulations!r} were given.",
            "A study needs at least one pair (n, k) of whole numbers, and one formulation.",
            do="Give cases such as [(4, 2)].",
            cases=cases,
            formulations=formulations,
        )
    rows = [row for n, k in pairs for row in _measured(n, k, derive(*build(n, k)), formulations, timed)]
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return FormulationCost("formulationcost", columns, {"points": POINTS, "machine": machine()})


def _measured(n, k, model, formulations, timed):
    rng = np.random.default_rng(SEED)
    points = POINTS if timed else FEW
    t, x = np.zeros(points), rng.uniform(0.2, 1.2, (len(model.state_names), points))
    first, rows = None, []
    for how in formulations:
        f = formulation(model, how)
        if how == "assembly":
            size = model.n + model.reduction.realisation.B.shape[1]
            count = f.operations + round(2 * size**3 / 3 + 2 * size**2)
            counts = (count, count)
        else:
            counts = (f.operations, formulation(model, how, forces=True).operations)

        def evaluate(f=f, dense=how == "assembly"):
            y = f.grid(t, x, model.p)
            return _solved(y, model.n) if dense else y

        accelerations = evaluate()
        seconds = min(_seconds(evaluate) for _ in range(REPEATED)) if timed else np.nan
        first = accelerations if first is None else first
        difference = np.abs(accelerations - first).max() / np.abs(first).max()
        cost = {"operations": counts[0], "with_forces": counts[1], "microseconds": 1e6 * seconds / points}
        rows.append({"n": n, "k": k, "formulation": NAMES[how], **cost, "difference": float(difference)})
    return rows


def _seconds(evaluate):
    began = perf_counter()
    evaluate()
    return perf_counter() - began


def _solved(y, n):
    """γ'' from assembled systems, one after another as a simulation would."""
    size = round((np.sqrt(1 + 4 * len(y)) - 1) / 2)
    matrices, right = y[: size * size].T.reshape(-1, size, size).swapaxes(1, 2), y[size * size :].T
    return np.array([np.linalg.solve(a, b) for a, b in zip(matrices, right, strict=True)]).T[:n]
