"""Checks of a run against the full mechanism, at its samples and at instants between them."""

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from servoctl.checks import whole
from servoctl.control.result import Closed
from servoctl.errors import ServoError, SpecificationError
from servoctl.methods.sizes import sizes_of
from servoctl.model.jets import extended, jet_names_to
from servoctl.model.switching import switching
from servoctl.model.variants import derived_near, place_of, variant_at
from servoctl.progress import stage
from servoctl.run import SAME_TIME, Run, on_side, require_run, sides
from servoctl.values import evenly, frozen
from servoctl.verification.between import Edges, Flow, between
from servoctl.verification.loop import verify_loop
from servoctl.verification.remarks import of_loop, of_run
from servoctl.verification.result import Verification, judged, largest, numbers

LIMITS = {
    "samples": 0.0,
    "signals": 1e-9,
    "balance": 1e-9,
    "segments": 1e-6,
    "energy": 1e-5,
    "higher jets": 1e-6,
    "residual": 1e-6,
    "switches": 1e-6,
}
INTEGRATED = 1e-6  # limit for the balance that drift disturbs: γ'' is integrated itself, or rows are hidden
ROUNDING = 1e-13  # part of the sum of all terms, multiplied out, that is rounding: some hundred roundings
PROBE, PROBES = 1e-7, 3  # relative change by which a response is measured, and in how many directions
FLOOR = 1e-3  # least size of a component, relative to what carries the same energy (`sizes_of`)
OWN_INSTANTS = 200  # instants between samples at which everything is checked
AT_PIVOT_ZERO = 1e-6  # of the least singular value of B: below it B_D is singular, and inputs have no digits
CONSERVED = 1e-9  # part of dE/dt, relative to its terms, that does not follow from the forces: more is no rounding
FEW_SIZES = 20  # instants at which the sizes of residuals are measured
MOST_SEGMENTS = 10_000  # steps along the run that are accepted: seconds
MOST_OWN_PIVOTS = 3  # choices of pivots of its own, where those of the run vanish between samples


@stage("verifying")
def verify(run: Run | Closed, segments: int = 20) -> Verification:
    """Check a run against the full mechanism, not the reduced model.

    At every sample, and at instants between samples, the mechanism's balance must hold for the run's accelerations
    under its actuation, and the residuals must vanish at every level. From each sample to the next the motion is
    integrated again, by steps as short as it requires, so that the verdict does not depend on the distance of the
    samples, and the energy gained is compared with the work done.

    An error is relative to the sizes of the terms that it is a sum of, in which rounding is allowed for.

    A closed loop is run again and all its signals are compared; its energy against the work of inputs, disturbances
    and friction, with two lengths of step; material constraints; limits.

    Parameters
    ----------
    run : Run or Closed
        A run that was loaded from a file needs its model: `load(path, model)`.
    segments : int
        Number of steps along the run, from 1 to 10,000; each interval between samples has at least one.

    Returns
    -------
    Verification
        Its verdict is "inconclusive" where a motion is too fast for the steps, or the run has a single sample.

    Raises
    ------
    SpecificationError
        If the run has no model, or segments is not a whole number from 1 to 10,000.
    """
    segments = whole("segments", segments, least=1, most=MOST_SEGMENTS)
    if isinstance(run, Closed):
        found = verify_loop(run)
        return found if found.failures else replace(found, remarks=of_loop(run))
    run, faulty = _required(run)
    if faulty or not len(run.t):
        return judged({"samples": float(faulty or 1)}, {"samples": LIMITS["samples"]})
    checks = _Checks(run, segments)
    found = {
        **checks.signals(),
        "balance": checks.balance(),
        **checks.energy(),
        **checks.higher_jets(),
        **checks.outside(),
        **checks.switches(),
        **checks.residuals(),
    }
    found |= {"segments": checks.segments()} if len(run.t) > 1 else {}
    limits = {key: checks.limit("residual" if key.startswith("residual ") else key) for key in found}
    said = judged(found, limits, checks.notes, checks.doubts)
    return said if said.failures else replace(said, remarks=of_run(run))


# --- what is verified


def _required(run):
    """The run as far as samples are finite, and the number of faulty samples.

    A motion that stopped may end in samples without accelerations.
    """
    model = require_run(run, "verify")
    t, jets, knots = numbers(run.t, 1), numbers(run.jets, 2), numbers(run.knots, 1)
    least, mappings = len(model.jet_names), (run.stored, run.stored_residual)
    whole_levels = jets is not None and len(jets) >= least and (len(jets) - least) % model.n == 0
    plain = isinstance(run.variants, tuple) and isinstance(run.success, bool | np.bool_) and isinstance(run.method, str)
    plain = plain and all(isinstance(mapping, Mapping) for mapping in mappings)
    if t is None or knots is None or not plain or not whole_levels or jets.shape[1] != len(t):
        raise SpecificationError(
            f"The run has times of shape {np.shape(run.t)} and jets of shape {np.shape(run.jets)}.",
            f"It has one time and {least} jets, or more by multiples of {model.n}, a sample, and signals by name.",
            do="Pass a run as sv.simulate returns it.",
            times=np.shape(run.t),
            jets=np.shape(run.jets),
        )
    good = np.isfinite(t) & np.all(np.isfinite(jets), axis=0)
    count = len(t) if run.success or not good.any() else 1 + int(np.flatnonzero(good)[-1])
    steps = np.diff(t[:count])
    backwards = count > 1 and t[count - 1] < t[0]
    faulty = int(np.sum(~good[:count]) + np.sum((steps >= 0) if backwards else (steps <= 0)))
    parts = {"variants": _variants(model, run, count), "knots": tuple(knots)}
    parts |= {
        what: {name: np.asarray(values)[..., :count] for name, values in kept.items() if np.ndim(values)}
        for what, kept in zip(("stored", "stored_residual"), mappings, strict=True)
    }
    return replace(run, t=t[:count], jets=jets[:, :count], jet_names=jet_names_to(model, len(jets)), **parts), faulty


def _variants(model, run, count):
    """Ranges of samples and their variants, of this model itself: a run says on which sides and near which places."""
    with contextlib.suppress(ServoError, LookupError, TypeError, ValueError):
        there = [(a, b, on_side(model, sides(model, v)), place_of(v)) for a, b, v in run.variants if a < count]
        made = [(a, min(b, count), variant_at(side, place)) for a, b, side, place in there]
        if [0, *(end for _, end, _ in made)] == [*(first for first, *_ in made), count]:
            return tuple(made)
    return ((0, count, model),)


@frozen
class _Instants:
    """Instants at which one variant of the model is evaluated: times (N,), jets (n_z, N) and inputs (m, N)."""

    model: object
    t: np.ndarray
    z: np.ndarray
    inputs: np.ndarray

    @property
    def few(self):
        """Indices of the instants at which sizes are measured."""
        return evenly(len(self.t), FEW_SIZES)

    def signals(self, kind):
        f = self.model.signals(kind)[1]
        return f.grid(self.t, self.z[: f.n_x], self.model.p)


class _Checks:
    """The checks of one run; `notes` and `doubts` collect what does not apply and what cannot be decided."""

    def __init__(self, run, segments):
        model = run.model
        self.model, self.run, self.notes, self.doubts = model, run, [], []
        of_series = run.method == "Taylor" and len(run.jets) > len(model.jet_names)
        self.drifts = of_series or model.reduction.top > 2 or (model.reduction.hidden and run.method != "algebraic")
        self.stored, self.fresh = run.stored, replace(run, stored={}, stored_residual={})
        self.samples = [
            _Instants(v, run.t[a:b], run.jets[:, a:b], inputs)
            for (a, b, v), inputs in zip(run.variants, self._inputs(), strict=True)
        ]
        switched = any(sides(model, v) for *_, v in run.variants)
        self.family = switching(model) if switched else None
        self.mass = self._mass()
        self.sizes = self._sizes(self.samples)
        powers = np.concatenate([at.signals("power") for at in self.samples], axis=1)
        rate, _, size, law, terms = np.abs(powers).max(axis=1)
        velocities, accelerations = (self.sizes[model.nq + k * model.n :][: model.n] for k in (0, 1))
        self.balanced = law <= CONSERVED * max(rate, size, (self.mass * velocities * accelerations).max())
        self.energies = np.concatenate([at.signals("energy") for at in self.samples], axis=1)[0]
        size = max((self.mass * velocities**2).max() / 2, np.ptp(self.energies))
        self.energy_size = size + ROUNDING / LIMITS["energy"] * terms or 1.0
        self.instants = self.samples
        if len(run.t) > 1:
            self.edges = self._edges(segments)
            self.between = between(self._attempts(), self.edges)
            self.instants = [*self.samples, *self._own()]
            self.sizes = self._sizes(self.instants)
        else:
            self.doubts.append("one sample is no motion: simulate with more samples")
        if not run.success:
            self.notes.append("the run did not reach its end: errors grow near a singularity")

    def limit(self, key):
        """The limit of a number."""
        return INTEGRATED if self.drifts and key == "balance" else LIMITS.get(key, np.inf)

    def _inputs(self):
        """The actuation, or the reaction of an ideal program, as the run gives it, by variant."""
        names = self.model.signals("reaction" if self.model.reduction.ideal else "actuation")[0]
        stored = ((name, numbers(self.stored.get(name, np.nan), 1)) for name in names)
        alike = {name: v for name, v in stored if v is not None and v.shape == self.run.t.shape}
        values = np.array([alike.get(name, self.fresh[name]) for name in names]).reshape(len(names), len(self.run.t))
        return [values[:, a:b] for a, b, _ in self.run.variants]

    # sizes

    def _mass(self):
        """The largest inertia of each velocity along the run, (n,) array."""
        at, f = self.samples[0], self.samples[0].model.function("matrices")
        return np.abs(f.grid(at.t[at.few], at.z[: f.n_x, at.few], at.model.p)[-self.model.n :]).max(axis=1)

    def _sizes(self, instants):
        """The size of each jet (n_z,): its largest value, at least FLOOR of what carries the same kinetic energy."""
        largest = np.zeros(len(self.run.jets))
        for at in instants:
            largest[: len(at.z)] = np.maximum(largest[: len(at.z)], np.abs(at.z).max(axis=1))
        others = sizes_of(self.model, self.mass, largest, np.ptp(self.run.t) or 1.0)
        sizes = np.maximum(largest, FLOOR * others)
        return np.where(sizes > 0, sizes, 1.0)

    def _response(self, f, t, x, y, steps):
        """Change of f(t, x, p) = y if each entry of x changes by its step: root mean square over random directions."""
        directions = np.random.default_rng(0).standard_normal((PROBES, len(x), 1))
        with np.errstate(all="ignore"):
            changes = [np.nan_to_num(f(t, x + PROBE * d * steps) - y) / PROBE for d in directions]
        return np.sqrt(np.mean(np.square(changes), axis=0))

    # between samples

    @property
    def flat(self):
        """Whether the motion is solved for q at each instant, and not integrated."""
        return self.model.flat and self.run.method == "algebraic"

    def _edges(self, segments):
        """The samples, and the knots between them."""
        run, knots = self.run, np.asarray(self.run.knots)
        ordered = np.sort(run.t)
        after = np.clip(np.searchsorted(ordered, knots), 1, len(ordered) - 1)
        near = np.minimum(np.abs(ordered[after - 1] - knots), np.abs(ordered[after] - knots))
        knots = knots[(near > SAME_TIME * (1 + np.abs(knots))) & (knots > ordered[0]) & (knots < ordered[-1])]
        t = np.union1d(run.t, knots)[:: 1 if run.t[-1] > run.t[0] else -1]
        sampled, n_x = np.isin(t, run.t), self.model.nq if self.flat else len(self.model.state_names)
        known = np.full((n_x + 1, len(t)), np.nan)
        gained = np.diff(self.energies, prepend=self.energies[0]) if self.balanced else np.zeros(len(run.t))
        known[:, sampled] = np.vstack([run.jets[:n_x], gained])
        of_work = self.energy_size / len(t) * LIMITS["energy"] / LIMITS["segments"]
        sizes = np.append(self.sizes[:n_x], of_work)
        steps = max(-(-segments // (len(t) - 1)), 1 + -(-OWN_INSTANTS // (len(t) - 1)))
        return Edges(t, sampled, known, sizes, LIMITS["segments"], steps)

    def _attempts(self):
        """The flows to try from edges on: of the variants next to their samples, and of one with its own pivots.

        Each attempt is a function of the indices (K,) of edges and returns pairs of a flow and of those that it leads
        on. Edges lie on all switches, so that the model itself is smooth between them.
        """
        variants = [self.model if self.family and not self.flat else v for *_, v in self.run.variants]
        first = np.array([next(i for i, v in enumerate(variants) if v is variant) for variant in variants])  # the same
        sample = np.cumsum(self.edges.sampled) - 1
        of = np.searchsorted([a for a, *_ in self.run.variants], sample, side="right") - 1

        def flow(model):
            return Flow(model, self.flat, self.balanced)

        def next_to(ks, shift=0):
            ks = ks[of[ks] + shift < len(variants)]
            model = first[of[ks] + shift]
            return [(flow(variants[j]), ks[model == j]) for j in np.unique(model)]

        def own_sides(ks):  # whose residuals count, in which angles may have turned round
            ks = ks[first[of[ks]] != first[of[np.searchsorted(sample, sample[ks] + 1)]]]
            t = (self.edges.t[ks] + self.edges.t[ks + 1]) / 2
            z = self.run.at(t)
            return [(flow(model), ks[which]) for model, which in self._sides(self.model, t, z)]

        def own_pivots(ks):
            found = []
            for k in ks[:MOST_OWN_PIVOTS]:
                with contextlib.suppress(ServoError):
                    at = self.run.jets[: len(self.model.jet_names), sample[k]]
                    found.append((flow(derived_near(self.model, self.run.t[sample[k]], at)), [k]))
            return found

        sides = [own_sides] if self.flat and self.family else []
        return [*sides, next_to, partial(next_to, shift=1), own_pivots]

    def _own(self):
        """Instants inside the intervals, some OWN_INSTANTS of them, by variant."""
        by_flow = {}
        for flow, t, z in self.between.inside:
            by_flow.setdefault(flow, []).append((t, z))
        own = []
        for flow, parts in by_flow.items():
            t, z = (np.concatenate(values, axis=-1) for values in zip(*parts, strict=True))
            few = np.unique(np.linspace(0, len(t) - 1, OWN_INSTANTS).astype(int))
            t, z = t[few], z[:, few]
            z = flow.values(t, flow.settled(t, z[: self.model.nq]))[1] if self.flat else z
            regular = _regular(flow.model, t, z)
            t, z = (t[regular], z[:, regular]) if regular.any() else (t, z)
            for model, which in self._sides(flow.model, t, z):
                instants = _Instants(model, t[which], z[:, which], None)
                own.append(replace(instants, inputs=instants.signals("inputs")))
        return own

    def _sides(self, model, t, z):
        """The models on the sides of the switches on which instants lie, with the indices of these instants."""
        if self.family is None:
            return [(model, slice(None))]
        forward = self.run.t[-1] > self.run.t[0]
        before = np.searchsorted(self.run.t if forward else -self.run.t, t if forward else -t, side="right") - 1
        groups = {}
        for k, sample in enumerate(before):
            known = sides(self.model, self.run.variant(sample))
            branches = self.family.branches(t[k], z[: len(self.model.state_names), k], known)
            groups.setdefault(branches, []).append(k)
        return [(self.family.at(branches), which) for branches, which in groups.items()]

    def segments(self):
        """Largest difference of the states from those integrated from the sample before."""
        resolved = self.between.resolved
        unknown = np.flatnonzero(~resolved)
        if len(unknown):
            first = self.run.t[np.cumsum(self.edges.sampled)[unknown[0]] - 1]
            where = f"{len(unknown)} of {len(resolved)} intervals between samples, the first from {first:.6g} s"
            what = "the motion is too fast to follow, or singular: simulate with more samples (t_eval)"
            self.doubts.append(f"in {where} on, {what}")
        return largest((self._off()[:-1] / self.sizes[: len(self.edges.known) - 1, None])[:, self._known()])

    def _known(self):
        """Which samples after the first were reached."""
        return self.between.resolved[self.edges.sampled[1:]]

    def _off(self):
        """States reached at the samples after the first, and the work done, less what is known of them."""
        return (self.between.ends - self.edges.known[:, 1:])[:, self.edges.sampled[1:]]

    # the equations

    def balance(self):
        """Largest part of the mechanism's balance that the run's inputs leave, relative to the terms of each row."""
        n, n_z, rounding, parts = self.model.n, len(self.model.jet_names), ROUNDING / self.limit("balance"), []
        for at in self.instants:
            x = np.vstack([at.z[:n_z], at.inputs, at.signals("all_multipliers")])
            y = at.model.function("balanced").grid(at.t, x, at.model.p)
            felt = self._response(
                lambda t, x, at=at: at.model.function("balanced").grid(t, x, at.model.p)[:n],
                at.t[at.few],
                x[:, at.few],
                y[:n, at.few],
                1.0 + np.abs(x[:, at.few]),
            )
            parts.append([y[:n], y[n : 2 * n], y[2 * n :] + felt.max(axis=1, keepdims=True)])
        left, terms, sums = np.concatenate(parts, axis=2)
        return largest(_ratio(left, terms.max(axis=1, keepdims=True) + rounding * sums))

    def residuals(self):
        """Largest residual of each row at any level, by the relative change of the jets that would remove it."""
        names, _ = self.model.signals("residuals")
        worst, usual = {f"residual {name}": 0.0 for name in self.run.residual}, np.zeros(len(names))
        for at in self.instants:
            f = at.model.signals("residuals")[1]
            levels, few = at.signals("residuals"), at.few
            sizes = self._response(
                lambda t, z, f=f, p=at.model.p: f.grid(t, z, p),
                at.t[few],
                at.z[: f.n_x, few],
                levels[:, few],
                self.sizes[: f.n_x, None],
            )
            medians = np.median(sizes, axis=1)
            usual = np.fmax(usual, medians)
            for (name, _), level, size in zip(names, levels, medians, strict=True):
                worst[f"residual {name}"] = max(worst[f"residual {name}"], largest(_ratio(level, size)))
        for (name, level), size in zip(names, usual, strict=True) if self.run.stored_residual else ():
            stored, fresh = numbers(self.run.stored_residual.get(name), 2), self.fresh.residual[name]
            if stored is not None and stored.shape == fresh.shape:
                off = largest(_ratio(stored[level] - fresh[level], size))
                worst[f"residual {name}"] = max(worst[f"residual {name}"], off)
        for name in self.model.reduction.mechanism.reported:  # of a program that inputs realise approximately
            del worst[f"residual {name}"]
            self.notes.append(f"the program's residual {name} is at most {largest(self.fresh.residual[name]):.2g}")
        return worst

    def signals(self):
        """Largest difference of a stored signal from its value at the samples, relative to its largest value."""
        if not self.stored:
            return {}
        worst = 0.0
        for name, values in self.stored.items():
            try:
                again, values = self.fresh[name], numbers(values, 1)
            except ServoError:
                self.doubts.append(f"the stored signal {name!r} is none of the model's")
                continue
            off = np.inf if values is None or values.shape != again.shape else values - again
            worst = max(worst, largest(_ratio(off, np.abs(again).max())))
        return {"signals": worst}

    # energy

    def energy(self):
        """Largest difference of the energy gained from the work, relative to the kinetic energy and the work done."""
        if not self.balanced:
            self.notes.append("energy: not applicable, the inertia terms depend on time or on more than wᵀMw/2")
            return {}
        if len(self.run.t) < 2 or not self.between.resolved.all():
            return {}
        return {"energy": largest(np.cumsum(self._off()[-1]) / self.energy_size)}

    # further signals

    def higher_jets(self):
        """Largest error of the jets above the order of the model."""
        n_z, worst = len(self.model.jet_names), 0.0
        if len(self.run.jets) <= n_z:
            return {}
        for at in self.samples:
            again = extended(at.model, at.t, at.z[:n_z], len(at.z))
            worst = max(worst, largest((at.z - again) / self.sizes[:, None]))
        return {"higher jets": worst}

    def switches(self):
        """Largest change of a state, relative to its size, that leads it back to its side of a switch."""
        if self.family is None:
            return {}
        n_x, worst = len(self.model.state_names), 0.0
        for at in self.samples:
            functions, slopes, _ = self.family.values(sides(self.model, at.model), at.t, at.z[:n_x])
            reach = np.abs(slopes * self.sizes[:n_x, None]).sum(axis=1)
            worst = max(worst, largest(_ratio(np.minimum(functions, 0.0), reach)))
        return {"switches": worst}

    def outside(self):
        """Largest part of an ideal reaction outside the actuators' directions, relative to the reaction."""
        if not (self.model.reduction.ideal and self.model.actuators):
            return {}
        n, worst, size = self.model.n, 0.0, 1e-300
        for at in self.samples:
            values = at.signals("reach")
            size = max(size, np.abs(values[:n]).max())
            reaction, E = values[:n].T[:, :, None], values[n:].reshape(-1, n, len(at.t)).transpose(2, 1, 0)
            inverse = np.linalg.pinv(E, rcond=max(E.shape[1:]) * np.finfo(float).eps)
            worst = max(worst, largest(reaction - E @ (inverse @ reaction)))
        return {"outside": worst / size}


def _regular(model, t, z):
    """Whether the inputs are determined with the model's pivots at instants, (N,): B_D is as regular as B."""
    f, dependent, n = model.function("matrices"), list(model.reduction.realisation.dependent), model.n
    values = f.grid(t, z[: f.n_x], model.p)
    B = values[len(values) - n * (len(dependent) + 1) : -n].reshape(n, len(dependent), len(t)).T
    if not dependent or not np.all(np.isfinite(B)):
        return np.ones(len(t), dtype=bool)
    least, of_all = (np.linalg.svd(b, compute_uv=False)[:, -1] for b in (B[:, :, dependent], B))
    return least > AT_PIVOT_ZERO * of_all


def _ratio(errors, sizes):
    """Errors relative to sizes; zero errors of zero size are zero."""
    if np.all(sizes > 0):
        return errors / sizes
    sizes = np.broadcast_to(sizes, np.shape(errors))
    return np.divide(errors, sizes, out=np.where(errors == 0, 0.0, np.inf), where=sizes > 0)
