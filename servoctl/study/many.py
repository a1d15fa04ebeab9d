"""Many motions of one model, with different starts and parameters, in one compiled call."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import as_numbers, as_span, mapping, require_kind, whole
from servoctl.errors import ServoError, SpecificationError
from servoctl.methods.accuracy import ATOL, LARGE, absolute_tolerances
from servoctl.methods.choice import Method, Taylor, as_method
from servoctl.methods.lanes import fits, integrate
from servoctl.methods.taylor import order_for
from servoctl.model.model import Model
from servoctl.model.start import State
from servoctl.model.validity import affirmed_each
from servoctl.reduction.idle import names_of
from servoctl.simulation import OFF, as_state, simulated
from servoctl.study.cases import FAILURE, as_cases
from servoctl.study.table import Study, Traced, machine, table


@dataclass(frozen=True, eq=False)
class Motions(Traced):
    """The motions of many cases; made by `simulate_many`.

    `motions["final theta"]` is a column of the table, (N,), `motions.trace["theta"]` is (K, N).

    Attributes
    ----------
    study : Study
        A row per case: its parameters, the number of steps and the final value of each state. Those of motions that
        ended early are NaN; "error", "message" and "facts" have the reason.
    t : (K,) array
        Instants of the traces [s].
    trace : dict of str to (K, N) array
        The states at these.
    """

    def __repr__(self):
        failed = int(np.sum(self.study["error"] != ""))
        lines = [f"Motions: {len(self)} cases, {failed} ended early; {self.study.meta['method']}"]
        lines += [f"  traces at {len(self.t)} instants" if len(self.t) else "  no traces"]
        shown = [name for name in self.study.columns if name not in FAILURE[1:]][:8]
        return "\n".join([*(line[:120] for line in lines), *table(self.study, shown, most=5)])


def simulate_many(
    model: Model, starts: State | ArrayLike | Mapping[str, ArrayLike], parameters: Mapping[str, ArrayLike] | None,
    t_span: Sequence[float], method: Method | str | None = None, *, t_eval: ArrayLike | None = None,
    threads: int | None = None,
) -> Motions:  # fmt: skip
    """Simulate the motion of a program for many starts and sets of parameters.

    By the Taylor method the motions run in compiled code, in the lanes of vectors with steps of their own, and on
    threads, where the equations are polynomials of the state and of sines and cosines that do not depend on time. All
    other motions, and those whose pivots fall, run one after the other, as `simulate` computes them. The result of a
    case equals that of `simulate` to rounding, and depends neither on other cases nor on threads.

    Parameters
    ----------
    model : Model
    starts : State, (n_x,) or (n_x, N) array, or dict of str to float or (N,) array
        Consistent states, one for all cases or one for each; or values by name from which `model.start` makes the state
        of each case with its parameters.
    parameters : dict of str to (N,) array, sequence of dict, or None
        Parameters of each case by name, SI, such as from `grid` or `monte_carlo`; None for those of the model.
    t_span : (t0, t1)
        [s]; t1 < t0 runs backwards.
    method : Method or str, optional
        Default: `Taylor()`; for a program that determines the motion completely "algebraic".
    t_eval : (K,) array, optional
        Times of the traces [s]; default: no traces.
    threads : int, optional
        Default: one per core.

    Returns
    -------
    Motions
        A case that fails is a row with the error. After Ctrl-C it holds the finished cases, with `meta["interrupted"]`
        True.

    Raises
    ------
    NameUnknown
        For a name that is no parameter.
    SpecificationError
        If the cases form no table, or method or times are invalid.
    """
    model = require_kind(Model, "model", model, "sv.derive(...)").including(names_of(starts))
    span, threads = as_span(t_span), threads if threads is None else whole("threads", threads, least=1)
    method = as_method(method) if method is not None else as_method("algebraic") if model.flat else Taylor()
    times = _trace_times(span, t_eval)
    motions = _Many(model, *_case_table(model, starts, parameters), len(times))
    if isinstance(method, Taylor) and fits(model):
        motions.in_lanes(span, method, times, threads)
    interrupted = motions.one_by_one(span, method, times)
    return motions.result(times, {"t_span": list(span), "method": str(method), "interrupted": interrupted})


def _case_table(model, starts, parameters):
    """Parameters of each case (list of dict); a start of all cases, columns (N,) by name, or states (N, n_x)."""
    cases, lengths = [{}], set()
    if parameters is not None:
        cases = as_cases(parameters)
        lengths.add(len(cases))
    if isinstance(starts, Mapping):
        starts = {name: as_numbers(values) for name, values in mapping(starts, "The starts").items()}
        valid = all(values.ndim < 2 and np.isfinite(values).all() for values in starts.values())
        lengths |= {len(values) for values in starts.values() if values.ndim == 1}
    elif not isinstance(starts, State):
        starts = as_numbers(starts).T
        valid = starts.ndim in (1, 2) and starts.shape[-1] == len(model.state_names) and np.isfinite(starts).all()
        lengths |= {len(starts)} if starts.ndim == 2 else set()
    if not isinstance(starts, State) and not valid or len(lengths) > 1 or 0 in lengths:
        raise SpecificationError(
            f"The starts and parameters have the lengths {', '.join(map(str, sorted(lengths))) or '(none)'}.",
            f"A state has {len(model.state_names)} finite entries, and all columns have one number for each case.",
            do="Pass one start for all cases, or as many as there are sets of parameters.",
            lengths=sorted(lengths),
            names=model.state_names,
        )
    return cases * max(lengths, default=1) if len(cases) == 1 else cases, starts


def _trace_times(span, t_eval):
    times = np.unique(as_numbers([] if t_eval is None else t_eval))
    if times.size and not (np.isfinite(times).all() and min(span) <= times[0] and times[-1] <= max(span)):
        raise SpecificationError(
            f"t_eval={repr(t_eval)[:150]} was given.",
            f"Samples are finite times within t_span, {min(span):g} to {max(span):g} s.",
            t_eval=t_eval,
            t_span=span,
        )
    return times if span[1] > span[0] else times[::-1]


class _Many:
    """The cases, and what is known of their motions so far."""

    def __init__(self, model, cases, starts, n_times):
        self.model, self.cases, self.starts, self.models = model, cases, starts, {}
        n, n_x = len(cases), len(model.state_names)
        self.done, self.steps, self.errors = np.zeros(n, bool), np.full(n, np.nan), {}
        self.final, self.samples = np.full((n, n_x), np.nan), np.full((n, n_times, n_x), np.nan)

    def model_of(self, i):
        """The model with the parameters of a case; each set of parameters is checked once."""
        key = tuple(self.cases[i].items())
        if key not in self.models:
            self.models[key] = self.model.with_parameters(**self.cases[i]) if key else self.model
        return self.models[key]

    def start(self, i, model, t):
        """The start of a case."""
        if isinstance(self.starts, dict):
            return model.start(t=t, **{name: float(v[i] if v.ndim else v) for name, v in self.starts.items()})
        return self.starts[i] if np.ndim(self.starts) == 2 else self.starts

    def in_lanes(self, span, method, times, threads):
        """Compute the cases that need nothing but steps."""
        which, x0, p = self._prepared(span[0])
        if not len(which):
            return
        order, top = order_for(method.rtol) if method.order is None else method.order, self.model.reduction.top
        last = max(order + top - 1, (method.jets or top) + 1)
        atol = np.full(len(which), ATOL if method.atol is None else method.atol)
        ends, samples = integrate(self.model, last, span, (x0, p, atol), method.rtol, times, threads)
        if ends is None:
            return
        x, largest = np.split(ends[:, 3:], 2, axis=1)
        good = (ends[:, 0] > 0) & self._consistent(span[0], x0, p) & self._consistent(span[1], x, p)
        if method.atol is None:
            good &= self._default_fits(span, x0, largest, method.rtol)
        here = which[good]
        self.done[here], self.final[here], self.steps[here] = True, x[good], ends[good, 1]
        self.samples[here] = samples[good]

    def _prepared(self, t):
        """Cases (K,) for which the derivation holds, their states (K, n_x) and parameters (K, n_p)."""
        affirmed, which, states, values = self._affirmed(), [], [], []
        for i in range(len(self.cases)):
            try:
                model = self.model if i in affirmed else self.model_of(i)
                if model.reduction is self.model.reduction and not model.knots:
                    states.append(as_state(model, self.start(i, model, t), t))
                    values.append(affirmed.get(i, model.parameters))
                    which.append(i)
            except ServoError:
                continue  # it fails again, and becomes a row, where the case is computed by itself
        return np.array(which, dtype=int), np.array(states), np.array(values)

    def _affirmed(self):
        """Parameters of cases for which the derivation holds, as far as double precision affirms it at once."""
        by_name = isinstance(self.starts, dict)  # whose states depend on them
        if by_name or self.model.reduction.timed or not self.cases[0]:
            return {}
        symbols, numbers, values = self.model.reduction.mechanism.parameters, self.model.numbers, {}
        for i, case in enumerate(self.cases):
            with contextlib.suppress(ServoError):
                values[i] = symbols.values({**numbers, **case})
        valid = affirmed_each(self.model, np.array([*values.values()]).T) if values else []
        return {i: each for (i, each), holds in zip(values.items(), valid, strict=True) if holds}

    def _consistent(self, t, x, p):
        """Whether states (N, n_x) satisfy the invariants."""
        f, m = self.model.function("invariants"), len(self.model.invariant_names())
        y = f.grid(t, x.T, p.T)
        slopes = y[m:].reshape(x.shape[1], m, -1)
        with np.errstate(all="ignore"):
            sizes = np.sqrt((slopes**2 * (1.0 + np.abs(x.T))[:, None] ** 2).sum(axis=0))
            return ~(np.abs(y[:m]) > OFF * np.where(sizes > 0, sizes, 1.0)).any(axis=0)

    def _default_fits(self, span, x0, largest, rtol):
        """Whether the default absolute tolerance is a small part of the sizes (N, n_x) of a motion, and no rounding."""
        fits = np.ones(len(x0), bool)
        for i in np.flatnonzero((largest.max(axis=1) > LARGE) | (largest < ATOL / rtol).any(axis=1)):
            both = np.column_stack([x0[i], largest[i]])
            fits[i] = largest[i].max() <= LARGE and absolute_tolerances(self.model, np.array(span), both, rtol) is None
        return fits

    def one_by_one(self, span, method, times):
        """Compute the others as `simulate` does; whether Ctrl-C came."""
        try:
            for i in np.flatnonzero(~self.done).tolist():
                self._one(i, span, method, times)
        except KeyboardInterrupt:
            return True
        return False

    def _one(self, i, span, method, times):
        t_eval = np.union1d(times, [span[1]])[:: 1 if span[1] > span[0] else -1]
        try:
            model = self.model_of(i)
            run = simulated(model, self.start(i, model, span[0]), span, method, t_eval=t_eval, progress=False)
        except ServoError as error:
            facts = json.dumps(error.details, default=str)
            self.errors[i] = {"error": type(error).__name__, "message": str(error), "facts": facts}
        else:
            if not run.success:
                raise KeyboardInterrupt
            states = run.jets[: self.final.shape[1]].T
            self.final[i], self.steps[i] = states[-1], run.counters.get("steps", np.nan)
            self.samples[i] = states[np.isin(run.t, times)]
        self.done[i] = True

    def result(self, times, meta):
        """The table of the finished cases, and their traces."""
        which, names = np.flatnonzero(self.done), self.model.state_names
        if not len(which):
            raise KeyboardInterrupt
        columns = {"case": which} | {name: [self.cases[i][name] for i in which] for name in self.cases[0]}
        columns |= {"steps": self.steps[which]}
        columns |= {f"final {name}": self.final[which, j] for j, name in enumerate(names)}
        for name in FAILURE:
            columns[name] = np.array([self.errors.get(i, {}).get(name, "") for i in which.tolist()], dtype=str)
        trace = dict(zip(names, self.samples[which].transpose(2, 1, 0), strict=True)) if len(times) else {}
        meta = meta | {"machine": machine(), "units": self.model.reduction.mechanism.units}
        return Motions(Study("many", columns, meta), times, trace)
