"""The verdict on a case: a plan that `verify` passes and the reference confirms, or a refusal that it confirms."""

import re
import warnings
from dataclasses import dataclass

import casadi as ca
import numpy as np
from derivative_array import Reference
from work import TooMuchWork, at_most

import servoctl as sv

AGREE = 1e-7  # of accelerations and actuation, relative to 1 plus the largest of them
SPAN, SAMPLES = 0.4, 201  # s
INSTANTS = (0, 70, 200)  # samples at which the reference is asked
DOUBTFUL = 1e-5  # relative singular values below this confirm a refusal on rank
SHARP = 1e5  # sensitivities of accelerations above this confirm a refusal as singular
STEEPER = 30.0  # the growth of that sensitivity from start to stop that confirms a stop
POLE, FURTHER = 0.9, 1.2  # or with this power, as a pole does, where the start is this factor farther from the stop
BESIDE = (3.0, 1.0, 0.3, 0.1, 0.03, 0.01)  # distances [s, too] from a state at which the reference has no verdict
NEARLY = 0.99  # of the way to a stop before the first sample, which is followed again
POWER = 0.3  # or it grows at least with this power of one over the time that is left
ROUNDINGS = 16  # of the terms of a row, which rows that are nearly dependent amplify
LARGE = 1e4  # a motion that has grown so far may end
MOST_CALLS = 100_000_000  # of functions, for a case; half a million are usual


@dataclass(frozen=True)
class Verdict:
    """`outcome` is "right", "refused rightly", or "wrong: ..." with what is wrong; `detail` holds the numbers.

    Of a plan `tolerance` is what sensitivities of accelerations and actuation, and rounding of the rows, allow.
    """

    outcome: str
    detail: str = ""
    tolerance: float = AGREE

    @property
    def wrong(self):
        return self.outcome.startswith("wrong")


def specification(case):
    """The mechanism and the program of a case, as a user of the package writes them."""
    q = sv.coordinates(" ".join(f"q{i}" for i in range(case.n)))
    functions = {"t": q.t, "sin": ca.sin, "cos": ca.cos, "exp": ca.exp} | {f"q{i}": s for i, s in enumerate(q)}
    if case.V:
        V = [[eval(e, {}, functions) for e in row] for row in case.V]
        h = [eval(e, {}, functions) for e in case.h]
        q = q.with_quasi_velocities(" ".join(f"w{i}" for i in range(case.n)), V, h)
    for level in range(1, 8):
        names = [f"w{i}" + (f"_{level - 1}" if level > 1 else "") for i in range(case.n)]
        functions |= dict(zip(names, q.gamma(level), strict=True))
    functions["D"] = lambda e: q.dt(ca.SX(e))
    read = lambda text: ca.SX(eval(text, {}, functions))  # noqa: E731
    positions = [read(text) for text in case.positions]
    dynamics = {}
    if case.form == "gibbs":
        dynamics["gibbs"] = sum(sv.particle(q, m, x) for m, x in zip(case.masses, positions, strict=True))
    elif case.form == "kinetic":
        dynamics["kinetic"] = sum(m * q.dt(x) ** 2 / 2 for m, x in zip(case.masses, positions, strict=True))
    else:
        along = [(ca.jacobian(x, ca.vertcat(*q)) @ q.V).T for x in positions]
        dynamics["balance"] = sum(m * a * q.dt(x, 2) for m, a, x in zip(case.masses, along, positions, strict=True))
    actuators = {
        f"u{i}": [read(e) for e in text] if isinstance(text, tuple) else read(text)
        for i, text in enumerate(case.actuators)
    }
    mechanism = sv.Mechanism(
        q,
        potential=read(case.potential),
        forces=ca.vertcat(*map(read, case.forces)),
        actuators=actuators,
        constraints={f"material{i}": read(text) for i, text in enumerate(case.material)},
        **dynamics,
    )
    return mechanism, sv.Program({f"row{i}": read(text) for i, text in enumerate(case.rows)}, by=case.by)


@dataclass
class Attempt:
    """What the package made of a case, and the error that ended it."""

    stage: str = "specification"
    model: object = None
    start: object = None
    run: object = None
    proof: object = None
    error: object = None


def judge(case, drawn=None):
    """Run a case through the package and the reference; it ends as it does in the coordinates in which it was drawn."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"), at_most(MOST_CALLS):
            warnings.simplefilter("ignore")
            attempt = _attempt(case)
            verdict = _judged(case, attempt)
            return verdict if verdict.wrong or drawn is None else _alike(case, attempt, drawn, verdict)
    except TooMuchWork:
        return Verdict(f"wrong: more than {MOST_CALLS} calls")


def _attempt(case, verified=True):
    a, speed = Attempt(), "w" if case.V else "dq"
    guess = {f"q{i}": value for i, value in enumerate(case.guess)}
    guess |= {f"{speed}{i}": value for i, value in enumerate(case.speeds)}
    try:
        mechanism, program = specification(case)
        a.stage = "derive"
        a.model = sv.derive(mechanism, program, guess=guess)
        a.stage = "start"
        a.start = a.model.start(guess=guess)
        a.stage = "simulate"
        method = None if a.model.flat else sv.methods.Adaptive("DOP853", rtol=1e-12, atol=1e-13)
        a.run = sv.simulate(a.model, a.start, (0.0, SPAN), method, t_eval=np.linspace(0.0, SPAN, SAMPLES))
        if verified:
            a.stage = "verify"
            a.proof = sv.verify(a.run, segments=1)
    except (Exception, TooMuchWork) as error:  # noqa: BLE001
        a.error = error
    return a


def _judged(case, a):
    if isinstance(a.error, sv.errors.ServoError):
        return _refused(Reference(case), case, a.stage, a.error, a.start, a.model)
    if isinstance(a.error, TooMuchWork):
        return Verdict(f"wrong: more than {MOST_CALLS} calls in {a.stage}")
    if a.error is not None:
        return Verdict(f"wrong: {type(a.error).__name__} in {a.stage}", str(a.error))
    return _compared(Reference(case), case, a.model, a.run, a.proof)


def _alike(case, here, drawn, verdict):
    """The verdict on a case, wrong where it ends otherwise than in the coordinates in which it was drawn."""
    there = _attempt(drawn, verified=False)
    ends = [type(a.error).__name__ if a.error else "a plan" for a in (there, here)]
    if ends[0] != ends[1]:
        errors = " | ".join(f"{a.stage}: {a.error}" for a in (there, here))
        return Verdict(f"wrong: moved, {ends[1]} instead of {ends[0]}", errors)
    if here.error:
        return verdict
    if here.model.flat != there.model.flat:
        return Verdict(f"wrong: moved, flat {here.model.flat} instead of {there.model.flat}", verdict.detail)
    apart = {"start": _apart(case.as_drawn(here.start.values), there.start.values)}
    apart["motion"] = _apart(case.as_drawn(here.run.jets[:, INSTANTS]), there.run.jets[:, INSTANTS])
    apart["actuation"] = _apart(*(_force(c, a.run)[:, INSTANTS] for c, a in ((case, here), (drawn, there))))
    numbers = ", ".join(f"{what} {gap:.1e}" for what, gap in apart.items()) + "; " + verdict.detail
    other = next((what for what, gap in apart.items() if not gap <= verdict.tolerance), None)
    return Verdict(f"wrong: moved, another {other}", numbers) if other else Verdict(verdict.outcome, numbers)


def _apart(here, there):
    """The largest difference relative to 1 plus the size of what is there."""
    return np.abs(here - there).max(initial=0.0) / (1 + np.abs(there).max(initial=0.0))


def _force(case, run):
    """Actuation, or the whole reaction of an ideal program as drawn, at samples."""
    return case.forces_as_drawn(run.signals("balance" if case.by == "ideal" else "actuation")[1])


def _coefficients(jets, n):
    """q and the Taylor coefficients of w, from q, w, w', ..."""
    w = jets[n:].reshape(-1, n).T
    return jets[:n], w / np.cumprod([1.0, *range(1, w.shape[1])])


def _at(reference, run, k):
    """What the reference determines at a sample, from the state there."""
    return reference.determined(run.t[k], *_coefficients(run.jets[: -reference.n, k], reference.n), near=True)


def _compared(reference, case, model, run, proof):
    n, top, force, (q_size, w_size) = case.n, reference.top, _force(case, run), case.sizes
    worst = {"acceleration": 0.0, "actuation": 0.0, "state": 0.0}
    unclear, gains, large = "", [], np.abs(case.as_drawn(run.jets)).max(axis=0) > LARGE
    for k in INSTANTS:
        solution = _at(reference, run, k)
        if large[k] and (solution is None or not solution.clear):  # beside a pole: the last sample before
            k = max(0, np.argmax(large) - 1)
            solution = _at(reference, run, k)
        q, w = _coefficients(run.jets[:, k], n)
        if solution is None or not solution.clear or solution.residual > AGREE:
            numbers = "none" if solution is None else f"loose {solution.loose:.1e}, residual {solution.residual:.1e}"
            unclear = f"at t = {run.t[k]:.2f}: {numbers}"
            continue
        gains.append(solution.gain)
        level = min(top, w.shape[1])
        here, there = (each[:, :level] / w_size[:, None] for each in (w, solution.w))
        size = 1 + np.abs(there).max()
        worst["state"] = max(worst["state"], np.abs((solution.q - q) / q_size).max() / size)
        worst["acceleration"] = max(worst["acceleration"], np.abs(here - there).max() / size)
        worst["actuation"] = max(worst["actuation"], _apart(force[:, k], case.forces_as_drawn(solution.force)))
    numbers = ", ".join(f"{name} {value:.1e}" for name, value in worst.items())
    numbers += f"; gain {max(gains, default=np.inf):.1e}; {unclear} {proof!r}"
    if unclear:
        return Verdict("wrong: a plan that the reference does not determine", numbers)
    tolerance = max(AGREE, AGREE * max(gains) / SHARP, _rounding(reference, case, run))
    if max(worst.values()) > tolerance:
        what = "failed by verify" if not proof.passed else "verified"
        return Verdict(f"wrong: another motion or force, {what}", numbers)
    if not proof.passed:
        return Verdict("wrong: verify fails a right plan (" + ", ".join(map(_kind, proof.failures)) + ")", numbers)
    return Verdict("right", numbers, tolerance)


def _rounding(reference, case, run):
    """What the rounding of nearly dependent rows, in coordinates with other origins, leaves undetermined."""
    if "nearly dependent" not in case.kinds or "hidden program row" in case.kinds:
        return 0.0  # given rows that hide others depend exactly
    apart = min(reference.ranks(run.t[k], *_coefficients(run.jets[: -case.n, k], case.n))["rows"] for k in INSTANTS)
    return ROUNDINGS * np.finfo(float).eps * max([1.0, *(abs(origin) for origin, *_ in case.moves)]) / apart


def _kind(failure):
    return "residual" if failure.startswith("residual") else failure


def _refused(reference, case, stage, error, start, model):
    what = f"{type(error).__name__} in {stage}"
    cause = _cause(reference, case, start, error, model)
    if cause:
        return Verdict("refused rightly", f"{what}: {cause} | {error}")
    return Verdict(f"wrong: refusal without cause, {what}, {_sentence(error)}", str(error))


def _growth(reference, run, t, last, end):
    """Whether the sensitivity of the accelerations grows without bound towards the stop at t, in words."""
    left = np.abs(t - run.t)
    earlier = np.flatnonzero((left >= 2 * left[last] + 1e-3) | (left >= 4 * left[last]))
    if not end.clear or end.gain > SHARP or left[0] < FURTHER * left[last]:
        return f"the sensitivity is {end.gain:.1e} at the stop" if not end.clear or end.gain > SHARP else ""
    for k, least, power in (*((k, 1.5, POWER) for k in earlier[-1:]), (0, STEEPER, 0.0), (0, FURTHER, POLE)):
        before = _at(reference, run, k)
        if before is not None and end.gain > before.gain * max(least, (left[k] / left[last]) ** power):
            return f"the sensitivity grows from {before.gain:.1e} at {run.t[k]:.3g} s to {end.gain:.1e} at {run.t[last]:.3g} s"
    return ""


def _sentence(error):
    """The error's first words without names and numbers, for the table."""
    return re.sub(r"[\d.e+-]+|'[^']*'", "…", str(error))[:60]


def _towards(model, start, stop, run):
    """The motion to a stop that came before the first sample, sampled; the run itself where there is none."""
    times = stop * np.linspace(0.0, NEARLY, 21)
    try:
        method = None if model.flat else sv.methods.Adaptive("DOP853", rtol=1e-12, atol=1e-13)
        return sv.simulate(model, start, (0.0, times[-1]), method, t_eval=times)
    except sv.errors.ServoError:
        return run


def _beside(reference, start, model):
    """Whether accelerations and actuation grow without bound towards a start, in words.

    Towards it lead later starts, and states of the same instant.
    """
    q_size, w_size = reference.case.sizes
    sizes = np.append(q_size, np.resize(w_size, len(start.names) - reference.n))
    rng = np.random.default_rng(1)
    directions = dict(zip(start.names, rng.uniform(-1, 1, len(start.names)) * sizes, strict=True))
    for later in (True, False):
        last = np.inf
        for distance in BESIDE[-2:] if later else BESIDE:
            moved = {name: start[name] + (0.0 if later else distance * d) for name, d in directions.items()}
            near = model.start(start.t + distance * later, guess=moved)
            solution = reference.determined(near.t, *_coefficients(near.values, reference.n), near=True)
            if solution is None or not solution.clear or solution.residual > 1e-9:
                continue
            if solution.gain > max(STEEPER, 2 * last):
                return f"next to the start the sensitivity is {last:.1e}, nearer {solution.gain:.1e}"
            last = solution.gain
    return ""


def _cause(reference, case, start, error, model):
    """What of the reference confirms a refusal; empty where nothing does."""
    t, q, w, near = 0.0, np.array(case.guess), np.array(case.speeds)[:, None], False
    run = error.run
    if run is not None and len(run.t) == 1 and model is not None and error.details.get("t", 0.0) > 0.0:
        run = _towards(model, start, error.details["t"], run)
    if start is not None:
        (q, w), near = _coefficients(start.values, case.n), True
    if run is not None and len(run.t) and np.all(np.isfinite(run.jets[:, -1])):
        t, (q, w) = run.t[-1], _coefficients(run.jets[: -case.n, -1], case.n)
        largest = np.abs(case.as_drawn(run.jets[:, -1])).max()
        if largest > LARGE:
            return f"the motion has grown to {largest:.1e}"
    points = [reference.determined(t, q, w[:, : reference.top - 1], near)]
    for seed in range(1, 4 if start is None else 1):  # ranks may fall at one point by accident
        rng = np.random.default_rng(seed)
        points.append(reference.determined(0.1 * seed, q + rng.normal(0, 0.3, case.n) * case.sizes[0], w[:, :1]))
    points = [p for p in points if p is not None]
    solved = [p for p in points if p.residual < 1e-9]
    last = -1
    while run is not None and not solved and 4 - last <= len(run.t):  # next to a stop the array may be singular
        last -= 1
        before = _at(reference, run, last)
        solved = [before] if before is not None and before.residual < 1e-9 else []
        if last < -5:
            break
    if not solved and start is not None:  # there is one, and the reference has no verdict there
        return _beside(reference, start, model)
    if not solved:
        return f"no consistent point: residuals {', '.join(f'{p.residual:.1e}' for p in points)}"
    if isinstance(error, sv.errors.InconsistentStart):
        return ""
    if not any(p.clear for p in solved):
        return f"accelerations or actuation undetermined at {len(solved)} points ({solved[0].loose:.1e})"
    if run is not None and len(run.t):
        growth = _growth(reference, run, float(error.details.get("t", t)), last, solved[0])
        if growth:
            return growth
    elif min(p.gain for p in solved) > SHARP:
        return f"accelerations and actuation have the sensitivity {min(p.gain for p in solved):.1e}"
    ranks = [reference.ranks(t, p.q, p.w) for p in solved]
    best = {key: max(rank[key] for rank in ranks) for key in ranks[0]}
    k, m = len(case.rows), len(case.actuators)
    if case.by != "ideal":
        if best["reach"] < k:
            return f"{best['reach']} independent actuators for {k} residuals"
        if best["directions"] < DOUBTFUL:
            return f"dependent directions ({best['directions']:.1e})"
        if m > k and best["decoupling"] < DOUBTFUL:
            return f"redundant, and the decoupling matrix lacks rank ({best['decoupling']:.1e})"
    if isinstance(error, sv.errors.SpecificationError) and "dependent" in case.kinds:
        return "a row is a multiple of another"
    if best["mass"] < DOUBTFUL:
        return f"inertia of least singular value {best['mass']:.1e}"
    return ""
