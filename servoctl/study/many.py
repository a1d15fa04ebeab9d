"""Many motions of one model, with different starts and parameters, in one compiled call."""

import contextlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor

import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import as_list, as_numbers, as_span, by_name, mapping, meant, plain, require_kind, whole
from servoctl.errors import ServoError, SpecificationError
from servoctl.methods.accuracy import ATOL, LARGE, coarse, unlike
from servoctl.methods.choice import Algebraic, Automatic, Method, Taylor, as_method
from servoctl.methods.lanes import OF_A_CASE, fits, integrate, plan_many, plans_fit
from servoctl.methods.sizes import sizes_of, state_levels
from servoctl.methods.taylor import order_for, stiff
from servoctl.model.following import breaks_within, moved_by, places_of
from servoctl.model.full import affirmed
from servoctl.model.model import Model, including
from servoctl.model.start import State
from servoctl.model.starts import linear_starts, same_start
from servoctl.progress import progress_bar
from servoctl.reduction.idle import names_of
from servoctl.simulation import OFF, as_state, sample_times, simulated
from servoctl.spec.paths.value import Path, PathAt
from servoctl.spec.references import followed_path, paths_at, required_paths
from servoctl.study.batch import FINAL, Batch, failure, of_finished
from servoctl.study.cases import as_columns
from servoctl.study.executor import computed, require_some, whole_run
from servoctl.study.signals import Signals

SHARES = 16  # of the cases, which the workers of an executor share


def simulate_many(
    model: Model,
    starts: State | ArrayLike | Mapping[str, ArrayLike],
    parameters: Mapping[str, ArrayLike] | None,
    t_span: Sequence[float],
    method: Method | str | None = None,
    *,
    paths: Mapping[str, Sequence[object]] | None = None,
    t_eval: ArrayLike | None = None,
    executor: Executor | int | None = None,
    progress: bool | None = None,
) -> Batch:
    """Simulate the motion of a program for many starts and sets of parameters.

    By the Taylor method the motions run in compiled code, in the lanes of vectors with steps of their own, and on
    threads, where the equations are polynomials of the state and of sines and cosines that do not depend on time. Plans
    of programs that determine the motion completely run in compiled code and on threads as well, unless kinks or
    switches may lie on their way. All other motions, and those whose pivots fall, run one after the other, as
    `simulate` computes them. The result of a case equals that of `simulate` to rounding, whatever the other cases and
    the threads.

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
        Default: the Taylor method, or "RadauIIA" for a case where stability limits its steps; for a program that
        determines the motion completely "algebraic".
    paths : dict of str to sequence of Path, optional
        Paths of each case by the names of references, as for `Model.with_references`; default: those of the model.
    t_eval : (K,) array, optional
        Times of the traces [s]; default: no traces.
    executor : int or concurrent.futures.Executor, optional
        The number of threads in this process, default: one per core; or an executor whose workers compute parts of the
        cases, each on one thread: processes, loky, or Dask's `client.get_executor()`. It is not shut down.
    progress : bool, optional
        Show a progress bar; default: on a terminal, for work of more than a second.

    Returns
    -------
    Batch
        Its table has the parameters, the number of steps and the final value of each state. A case that fails is a row
        with the error. After Ctrl-C it holds the finished cases, with `meta["interrupted"]` True.

    Raises
    ------
    NameUnknown
        For a name that is no parameter, or no reference.
    SpecificationError
        If the cases form no table, a path is none of one component, or executor, method or times are invalid.
    ServoError
        If the workers of the executor died before they finished a case.
    """
    model = including(require_kind(Model, "model", model, "sv.derive(...)"), names_of(starts))
    span = as_span(t_span)
    if executor is not None and not isinstance(executor, Executor):
        executor = whole("executor", executor, least=1)
    method = as_method(method) if method is not None else Algebraic() if model.flat else Automatic()
    times = sample_times(*span, t_eval, ()).copy() if np.size(t_eval) and t_eval is not None else np.array([])
    all_times = times if len(times) and times[-1] == span[1] else np.append(times, span[1])
    motions = _Many(model, *_case_table(model, starts, parameters, paths), len(all_times))
    with progress_bar("simulate_many", progress, motions.n, unit="case") as bar:

        def show(count):
            bar.update(count - bar.n)

        if isinstance(executor, Executor):
            motions.on(executor, (span, method, all_times), show)
        else:
            motions.compute(span, method, all_times, executor, show)
    study = motions.study({"t_span": list(span), "by": str(method)})
    level = max(getattr(method, "jets", None) or 0, model.reduction.top)
    return Batch(study, times, motions.signals(study["case"], all_times, len(times), level))


def _share_computed(part, span, method, times):
    """A part of the cases with its results, computed by a worker."""
    part.compute(span, method, times, 1, lambda count: None)
    part.models, part.followers = {}, {}
    return part


def _case_table(model, starts, parameters, paths):
    """Number of cases; parameters and paths by name; one start, starts by name, or states (N, n_x)."""
    columns = {} if parameters is None or isinstance(parameters, dict) and not parameters else as_columns(parameters)
    columns = {meant(name, model.numbers, "parameter") or name: column for name, column in columns.items()}
    paths = _columns_of_paths(model, paths)
    lengths = {len(column) for column in (*columns.values(), *paths.values())}
    if isinstance(starts, Mapping):
        starts = {name: as_numbers(values) for name, values in mapping(starts, "The starts").items()}
        valid = all(values.ndim < 2 and np.isfinite(values).all() for values in starts.values())
        lengths |= {len(values) for values in starts.values() if values.ndim == 1}
    elif not isinstance(starts, State):
        starts = as_numbers(starts).T
        valid = starts.ndim in (1, 2) and starts.shape[-1] == len(model.state_names) and np.isfinite(starts).all()
        lengths |= {len(starts)} if starts.ndim == 2 else set()
    n = max(lengths, default=1)
    if not isinstance(starts, State) and not valid or len(lengths) > 1 or 0 in lengths:
        raise SpecificationError(
            f"The starts, parameters and paths have the lengths {', '.join(map(str, sorted(lengths))) or '(none)'}.",
            f"A state has {len(model.state_names)} finite entries, and all columns have one number for each case.",
            do="Pass one start for all cases, or as many as there are sets of parameters.",
            lengths=sorted(lengths),
            names=model.state_names,
        )
    return n, columns, paths, starts


def _columns_of_paths(model, paths):
    """Lists of the paths of each case by name."""
    columns = by_name(mapping(paths, "The paths"), model.paths, "reference", "The paths")
    for name, column in columns.items():
        if isinstance(column, Path) or as_list(column) is None:
            raise SpecificationError(
                f"The paths of {name} are {column!r}."[:200],
                "They are a list with a path for each case.",
                do=f"Write {{{name!r}: [path, ...]}}, or model.with_references({name}=path) for one path in all cases.",
                name=name,
            )
    return {name: [followed_path(name, path) for path in column] for name, column in columns.items()}


class _Many:
    """The cases, and what is known of their motions so far."""

    def __init__(self, model, n, columns, paths, starts, n_times):
        self.model, self.n, self.columns, self.starts, self.models = model, n, columns, starts, {}
        moved = {r for r, _ in moved_by(model, columns)} - paths.keys()
        self.paths = paths | {name: [model.paths[name].source] * n for name in model.paths if name in moved}
        self.followers, self.knots = {}, []
        self.interrupted, n_x = False, len(model.state_names)
        self.done, self.steps, self.errors, self.runs = np.zeros(n, bool), np.full(n, np.nan), {}, {}
        self.parameters = np.tile(model.parameters, (n, 1))
        self.samples = np.full((n, n_times, n_x), np.nan)  # the last one at the end

    def model_of(self, i):
        """The model with the parameters and paths of a case; each set of parameters is checked once."""
        case = {name: plain(column[i]) for name, column in self.columns.items()}
        key = tuple(case.values())
        if key not in self.models:
            self.models[key] = self.model.with_parameters(**case) if case else self.model
        return self.models[key].with_references(**self.paths_of(i)) if self.paths else self.models[key]

    def paths_of(self, i):
        """The paths of a case, with its parameters, as paths of numbers."""
        paths = {name: column[i] for name, column in self.paths.items()}
        if self.columns:
            known = self.model.reduction.mechanism.parameters
            case = {name: plain(column[i]) for name, column in self.columns.items()}
            paths = paths_at(paths, known, known.values(self.model.numbers | case))
        return {name: path._with() if isinstance(path, PathAt) else path for name, path in paths.items()}

    def along(self, which):
        """The models that follow the paths of some cases, with the parameters of the model: made once, and kept."""
        if not self.paths:
            return [self.model] * len(which)
        for i in which:
            if i not in self.followers and i not in self.errors:
                self.followers[i] = self.model._along(self.model.paths | self.paths_of(i))
        return [self.followers.get(i, self.model) for i in which]

    def numbers(self, which, p):
        """Parameters p (N, n_p) of some cases as functions have them: after the places of the paths."""
        return np.hstack([places_of(self.along(which)).T, p])

    def start(self, i, model, t):
        """The start of a case."""
        if isinstance(self.starts, dict):
            return model.start(t=t, **{name: float(v[i] if v.ndim else v) for name, v in self.starts.items()})
        return self.starts[i] if np.ndim(self.starts) == 2 else self.starts

    def compute(self, span, method, times, threads, progress):
        """Compute all cases, as many as possible at once."""
        if isinstance(method, Taylor) and fits(self.model):
            self.in_lanes(span, method, times, threads, progress)
        elif isinstance(method, Algebraic) and plans_fit(self.model):
            self.plans(span, times, threads, progress)
        if not self.interrupted:
            self.one_by_one(span, method, times, progress)

    def on(self, executor, arguments, progress):
        """Compute parts of the cases on an executor; those that it does not finish are rows with its error."""
        parts = dict(enumerate(np.array_split(np.arange(self.n), min(self.n, SHARES))))
        calls = {k: (self.part(which), *arguments) for k, which in parts.items()}

        def take(k, part):
            self._join(parts[k], part)
            progress(int(self.done.sum()))

        lost, interrupted = computed(_share_computed, calls, executor, take)
        require_some(lost, self.done.any(), self.n)
        self.interrupted |= interrupted
        for k, failed in lost.items():
            self.errors |= dict.fromkeys(parts[k].tolist(), failed)
            self.done[parts[k]] = True

    def part(self, which):
        """The problem of some cases."""
        columns, starts = {name: [column[i] for i in which] for name, column in self.columns.items()}, self.starts
        if isinstance(starts, dict):
            starts = {name: values[which] if values.ndim else values for name, values in starts.items()}
        elif np.ndim(starts) == 2:
            starts = starts[which]
        paths = {name: [column[i] for i in which] for name, column in self.paths.items()}
        return _Many(self.model, len(which), columns, paths, starts, self.samples.shape[1])

    def _join(self, which, part):
        """Take the results of a part."""
        for name in ("done", "steps", "samples", "parameters"):
            getattr(self, name)[which] = getattr(part, name)
        for name in ("errors", "runs"):
            getattr(self, name).update((int(which[i]), value) for i, value in getattr(part, name).items())
        self.interrupted |= part.interrupted

    def in_lanes(self, span, method, times, threads, progress):
        """Compute the cases that need nothing but steps."""
        which, x0, p = self._prepared(span)
        if not len(which):
            return
        order, top = order_for(method.rtol) if method.order is None else method.order, self.model.reduction.top
        last = max(order + top - 1, (method.jets or top) + 1)
        atol = np.full(len(which), ATOL if method.atol is None else method.atol)
        cases, rtol = (x0, p, atol), method.rtol
        ends, samples, self.interrupted = integrate(self.model, last, span, cases, rtol, times, threads, progress)
        if ends is None:
            return
        good = (ends[:, 0] > 0) & (ends[:, 3] <= OFF)
        if getattr(method, "for_stiff", None) is not None:
            steps, at = abs(span[1] - span[0]) / np.maximum(ends[:, 1], 1), np.full(len(which), float(span[1]))
            last_states = np.ascontiguousarray(ends[:, len(OF_A_CASE) :][:, : x0.shape[1]].T)
            good &= ~stiff(self.model, at, last_states, p.T, steps, span[1] - span[0], order / np.e)
        good &= self._tolerances_fit(span, (x0, p), np.ascontiguousarray(ends[:, -x0.shape[1] :].T), method)
        self._take(which[good], ends[good], samples[good])

    def plans(self, span, times, threads, progress):
        """Compute the plans whose pivots do not fall."""
        which, x0, p = self._prepared(span)
        groups = {} if self.paths else {breaks_within(self.model, span): range(len(which))}
        for k, i in enumerate(which.tolist() if self.paths else ()):
            groups.setdefault(self.knots[i], []).append(k)
        for knots, some in groups.items():
            cases = x0[some], self.numbers(which[some], p[some])
            ends, samples, self.interrupted = plan_many(self.model, span, cases, times, knots, threads, progress)
            if ends is not None:
                good = ends[:, 0] > 0
                self._take(which[some][good], ends[good], samples[good])
            if self.interrupted:
                return

    def _take(self, which, ends, samples):
        """Take what was computed for some cases."""
        self.done[which], self.steps[which], self.samples[which] = True, ends[:, 1], samples

    def _prepared(self, span):
        """Cases (K,) for which the derivation and its knots hold, their states (K, n_x) and parameters (K, n_p)."""
        t, knots = span[0], () if self.paths else breaks_within(self.model, span)
        p, x = self.parameters, np.empty((self.n, len(self.model.state_names)))
        ready = self._affirmed(p)
        try:
            ready &= self._started(t, x, p)
        except ServoError:  # which is raised again, and becomes a row, for each case by itself
            ready[:] = False
        for i in np.flatnonzero(~ready).tolist():
            with contextlib.suppress(ServoError):
                model = self.model_of(i)
                if model.reduction is self.model.reduction and (self.paths or breaks_within(model, span) == knots):
                    x[i], p[i] = as_state(model, self.start(i, model, t), t), model.parameters
                    ready[i] = True
        ready &= self._smooth(span) if self.paths else True
        which = np.flatnonzero(ready)
        return which, x[which], p[which]

    def _smooth(self, span):
        """Cases (N,) whose paths are smooth enough within a span, whose knots are kept; other cases become errors."""
        smooth, self.knots, known = np.ones(self.n, bool), [()] * self.n, {}
        for i in range(self.n):
            try:
                (model,) = self.along([i])
                breaks = tuple(
                    (path.breaks.tobytes(), path.classes.tobytes(), path.before, path.after)
                    for path in required_paths(model.paths).values()
                )
                if breaks not in known:
                    known[breaks] = breaks_within(model, span)
                self.knots[i] = known[breaks]
            except ServoError:
                smooth[i] = False
        return smooth

    def _started(self, t, x, p):
        """Cases (N,) whose states x (N, n_x) follow for all cases at once; these are set."""
        if not isinstance(self.starts, dict):
            x[:] = as_state(self.model, self.starts, t) if isinstance(self.starts, State) else self.starts
        elif not self.paths and self._same_start():
            x[:] = self.start(0, self.model, t).values
        else:
            held = {name: np.broadcast_to(values, self.n) for name, values in self.starts.items()}
            x[:], solved = linear_starts(self.model, t, held, self.numbers(range(self.n), p))
            return solved
        return np.ones(self.n, bool)

    def _same_start(self):
        values = all(v.ndim == 0 for v in self.starts.values())
        return values and same_start(self.model, self.starts, self.columns)

    def _affirmed(self, p):
        """Cases (N,) for which double precision affirms the derivation; their parameters p (N, n_p) are set."""
        names = list(self.model.numbers)
        if not self.columns.keys() <= set(names):
            return np.zeros(self.n, bool)
        if not self.columns:
            return np.ones(self.n, bool)
        for name, column in self.columns.items():
            p[:, names.index(name)] = as_numbers(column)
        return affirmed(self.model, p.T.copy())

    def _tolerances_fit(self, span, cases, largest, method):
        """Whether motions with magnitudes (n_x, N), `from_start`, need no tolerances of their own, as in `simulate`."""
        default, levels = method.atol is None, state_levels(self.model)
        fit, doubtful = np.ones(largest.shape[1], bool), unlike(levels, largest)
        if default:
            fit = largest.max(axis=0) <= LARGE
            doubtful |= (largest < ATOL / method.rtol).any(axis=0)
        some = np.flatnonzero(doubtful)
        if len(some):
            x0, p = (part[some].T for part in cases)
            inertia = self.model.function("matrices").grid(span[0], x0, p)[-self.model.n :]
            sizes = sizes_of(self.model, inertia, largest[:, some], span[1] - span[0])
            fit[some] &= ~unlike(levels, largest[:, some], sizes) & ~(coarse(sizes, method.rtol).any(axis=0) & default)
        return fit

    def one_by_one(self, span, method, times, progress):
        """Compute the others as `simulate` does."""
        calls = {i: (i, span, method, times) for i in np.flatnonzero(~self.done).tolist()}
        self.interrupted = computed(self._one, calls, None, lambda *_: progress(int(self.done.sum())))[1]

    def _one(self, i, span, method, times):
        try:
            model = self.model_of(i)
            run = simulated(model, self.start(i, model, span[0]), span, method, t_eval=times, progress=False)
        except ServoError as error:
            self.errors[i] = failure(error)
        else:
            self.samples[i] = whole_run(run).jets[: self.samples.shape[2]].T
            self.steps[i], self.runs[i] = run.counters.get("steps", np.nan), run
        self.done[i] = True

    def study(self, meta):
        """The table of the finished cases."""
        columns = {name: np.array(column) for name, column in self.columns.items()} | {"steps": self.steps}
        names = (f"{FINAL}{name}" for name in self.model.state_names)
        columns |= dict(zip(names, self.samples[:, -1].T, strict=True))
        units = self.model.reduction.mechanism.units
        return of_finished("motions", self.done, columns, self.errors, meta | {"units": units})

    def signals(self, which, t, count, level):
        """The signals of the finished cases at the instants t, of which the first so many are those of the traces."""
        places = {i: k for k, i in enumerate(which.tolist())} if self.runs else {}
        runs = {places[i]: run for i, run in self.runs.items() if i in places}
        states, p = self.samples[which].transpose(2, 1, 0), self.parameters[which].T
        return Signals(self.along(which.tolist()), self.model, t, count, states, p, level, runs)
