"""The verdict on a program: what becomes of what it leaves free, and therefore which inverse it has.

At rest the eigenvalues of the internal dynamics decide; along a motion the growth of errors by the variational
equation does. Where the leading matrix loses its rank at rest, the zeros at infinity are compared with those in motion.
"""

from dataclasses import field

import numpy as np

from servoctl.errors import IntegrationStopped, ServoError, SingularProgram
from servoctl.growth import InternalDynamics, internal_dynamics
from servoctl.methods.bounded import End, FreeEntries
from servoctl.methods.choice import Bounded
from servoctl.methods.kinks import SMOOTHER, kink, stays_on_switch
from servoctl.model.following import corners_of, instants_of
from servoctl.model.model import Model, default_start
from servoctl.model.start import State
from servoctl.model.variants import strong_near
from servoctl.reduction.structure import margins
from servoctl.run import Run
from servoctl.tolerances import NOISE
from servoctl.values import frozen

FLAT, MINIMUM, MARGINAL, SINGULAR = "flat", "minimum phase", "marginal", "singular at rest"
HYPERBOLIC_ZEROS, GROWS = "non-minimum phase (hyperbolic)", "non-minimum phase"
UNDETERMINED, UNREALISABLE, OPEN = "undetermined", "not realisable", "inconclusive"
RELAXED = "relaxed"  # the word for the inverse that is no method of `simulate`
LOOKS = 5  # instants before and after a path at which the program must stand still for its end to be a rest
ASIDE = 0.25  # of the path's length: how far from it they lie
NEAR = 0.1  # of the sizes of the free entries: distance within which a run begins or ends in an unstable rest


@frozen
class Verdict:
    """What a program leaves free, and what becomes of it; made by `verdict`.

    Attributes
    ----------
    word : str
        "flat": the program determines the motion. "minimum phase": what it leaves free decays. "marginal": that neither
        decays nor grows exponentially. "non-minimum phase (hyperbolic)": it grows, and no eigenvalue at rest is on the
        imaginary axis. "non-minimum phase": errors grow along the run, or the two ends differ. "singular at rest": the
        relative degrees of the motion are lost where it begins or ends. "undetermined": more actuators than the program
        determines. "not realisable". "inconclusive": what was given decides nothing.
    reason : str
        The number or the fact that decides.
    do : str
        The remedy of an inconclusive verdict.
    dynamics : str
        The word for the motion that remains where weights choose among redundant actuators; `word` otherwise.
    rest : dict of str to End
        The rests "start" and "end" that exist, with eigenvalues.
    internal : InternalDynamics or None
        The growth of errors along a run.
    """

    word: str
    reason: str
    do: str = ""
    dynamics: str = ""
    rest: dict[str, End] = field(default_factory=dict, compare=False)
    internal: InternalDynamics | None = field(default=None, compare=False)

    def __post_init__(self):
        object.__setattr__(self, "dynamics", self.dynamics or self.word)

    @property
    def swings(self):
        """Whether a rest has eigenvalues on the imaginary axis."""
        return any(len(end.modes.on_axis) for end in self.rest.values())

    @property
    def growth(self):
        """How errors grow along the run, in words; "" without one."""
        said = "" if self.internal is None else self.internal.sentence().split("; ")[0]
        return said and f"along the run {said.removeprefix('internal dynamics ')}"

    def as_dict(self) -> dict:
        """The verdict as numbers, texts, lists and dicts, for JSON; eigenvalues are pairs [real, imaginary part]."""
        rest = {
            name: {"t": end.t, "state": end.x.tolist(), "eigenvalues": [[z.real, z.imag] for z in end.eigenvalues]}
            for name, end in self.rest.items()
        }
        growth = {} if self.internal is None else {n: _finite(v) for n, v in self.internal.facts().items()}
        facts = {"verdict": self.word, "reason": self.reason, "do": self.do, "dynamics": self.dynamics}
        return facts | {"rest": rest, "growth": growth}

    def __str__(self):
        return f"{self.word}: " + "; ".join(dict.fromkeys(filter(None, (self.reason, self.growth, self.do))))


def _finite(value):
    """A text, or a number that JSON has; None for others."""
    return value if isinstance(value, str) else float(value) if np.isfinite(value) else None


def verdict(model: Model, motion: Run | State | None = None) -> Verdict:
    """The verdict on a model's program.

    A run is judged at its ends and along it, a `State` as the start of a motion; by default it is the start near the
    guess of `derive`.
    """
    program, actuators = model.reduction.program, model.actuators
    if not program.residuals:
        return Verdict(OPEN, "this is a plant under inputs", "pass the model of a mechanism and its program")
    found = _of_motion(model, motion)
    if program.by == "ideal" or len(actuators) <= len(program.residuals):
        return found
    numbers = f"{len(actuators)} actuators ({', '.join(actuators)}), the program determines {len(program.residuals)}"
    reason = f"{numbers}, weights choose among them; then "
    return Verdict(UNDETERMINED, f"{reason}{found}", found.do, found.word, found.rest, found.internal)


def verdict_with(model, found, run):
    """The verdict found at a start; on its run where that decided nothing, the run stopped, or errors grow in it."""
    decides = found.dynamics == OPEN or run.status < 0 or run.internal.get("verdict") == "unstable"
    return verdict(model, run) if decides else found


def chosen_by(model, found, weighted=False):
    """The method of the exact inverse, None for the default of `simulate`, or `RELAXED`."""
    if found.dynamics == HYPERBOLIC_ZEROS:
        return Bounded()
    relaxes = found.dynamics in (SINGULAR, GROWS) or weighted and found.dynamics == MARGINAL
    return RELAXED if relaxes and not model.reduction.ideal else None


def _of_motion(model, motion):
    """The verdict, whatever the number of actuators."""
    try:
        states = _starting(model, motion)
    except SingularProgram as error:
        return Verdict(SINGULAR, _first_sentence(error))
    except ServoError as error:
        return Verdict(OPEN, f"no start was found: {_first_sentence(error)}", "pass model.start(...) or a run")
    lost = [reason for t, x in states if (reason := _lost_rank(_derived_for(model, motion, t, x), t, x))]
    if lost:
        return Verdict(SINGULAR, lost[0])
    if model.flat:
        return Verdict(FLAT, "no free initial value")
    rest, why = _rests(model, states, isinstance(motion, Run))
    switch = next(filter(None, (kink(model, end.t, end.x) for end in rest.values())), "")
    if switch:
        return _on_switch(model, motion, f"the rest lies on a switch, {switch}, and has no linearisation")
    internal = internal_dynamics(motion) if isinstance(motion, Run) else None
    lost = "" if rest or internal else _lost_at_default_start(model, states[0][0])
    return Verdict(SINGULAR, lost) if lost else _judged(rest, internal, why)


def _lost_at_default_start(model, t):
    """As `_lost_rank`, of the start near the guess of `derive`: a motion from elsewhere may have its rest there."""
    try:
        return _lost_rank(model, t, np.asarray(default_start(model, t).values, dtype=float))
    except ServoError:
        return ""


def _first_sentence(error):
    return str(error).split(". ")[0].rstrip(".")


def _starting(model, motion):
    """(t, state (n_x,)) where the motion begins and, for a run, where it ends."""
    n_x = len(model.state_names)
    if isinstance(motion, Run):
        known = np.flatnonzero(np.isfinite(motion.jets[:n_x]).all(axis=0))[[0, -1]]
        return [(float(motion.t[k]), motion.jets[:n_x, k]) for k in known]
    start = default_start(model) if motion is None else motion
    return [(start.t, np.asarray(start.values, dtype=float))]


def endpoints(model, motion):
    """A list of (t, state (n_x,)) where a run begins and ends, or a motion begins; empty if no start is known."""
    try:
        return _starting(model, motion)
    except ServoError:
        return []


def _derived_for(model, motion, t, x):
    """The model with the pivots that a run has at an instant, or a start needs."""
    if isinstance(motion, Run):
        return motion.variant(int(np.argmin(np.abs(motion.t - t)))) or model
    return strong_near(model, t, np.append(x, np.zeros(model.n)))


def _lost_rank(model, t, x):
    """What is lost where the equations have not the rank that they have in motion; "" if nothing is."""
    if margins(model.reduction, instants_of(model, [t]), x[:, None], model.parameters)[0] != 0:
        return ""
    there, usual = model.structure([t], x[:, None]), model.structure()
    if not (there.zeros_at_infinity and usual.zeros_at_infinity):
        return f"the equations of motion lose rank at t = {t:.4g} s"
    if there.zeros_at_infinity == usual.zeros_at_infinity:
        return ""
    local = there.at[0][1]
    return f"at t = {t:.4g} s {local.named(there.residuals)}; in motion {usual.at[0][1].named(usual.residuals)}"


def _rests(model, states, along):
    """The rests at the ends of a path, by name, and why there is none.

    `along` says whether the states are those of a run, which an unstable rest elsewhere says nothing of.
    """
    (t0, first), (t1, last) = states[0], states[-1]
    t1 = t1 if along else max((knot for knot in corners_of(model) if knot > t0), default=t0)
    sides = np.linspace(-1.0, 1.0, 2 * LOOKS + 1) * (-1.0 if t1 < t0 else 1.0)
    places = [("start", t0, first, sides[:LOOKS] if t1 != t0 else sides), ("end", t1, last, sides[LOOKS + 1 :])]
    rest, why = {}, ""
    try:
        entries = FreeEntries(model, t0, first)
    except ServoError as error:
        return rest, _first_sentence(error)
    for name, t, x, around in places[: 2 if t1 != t0 else 1]:
        try:
            end = entries.equilibrium(t, rest["start"].x if rest else x, moving=bool(rest))
        except IntegrationStopped as error:
            why = why or f"at t = {t:.4g} s: {_first_sentence(error)}"
            continue
        moved = entries.moved(end, t + _reach(end, t1 - t0) * around)
        far = along and end.unstable and np.abs((end.x - x) / entries.size)[entries.free].max() > NEAR
        if moved is None and not far and not _lost_rank(model, t, end.x):
            rest[name] = end
        elif moved is not None:
            why = why or f"at t = {moved:.4g} s the program does not stand still"
    return rest, why or "the motion is not about a rest"


def _reach(end, length):
    """How long the program must stand still around a rest [s]: a part of the path, or the time constant of a mode."""
    fastest = np.abs(end.eigenvalues).max(initial=0.0)
    return ASIDE * abs(length) or (1 / fastest if fastest else 1.0)


def _judged(rest, internal, why):
    """The verdict from eigenvalues at rest and the growth along a run."""
    facts, grows = {"rest": rest, "internal": internal}, internal is not None and internal.verdict == "unstable"
    if not rest:
        return _along(internal, why, facts)
    said = {name: eigenvalues(end) for name, end in rest.items()}
    same = len(said) == 2 and len({*said.values()}) == 1
    reason = f"at both ends {said['start']}" if same else "; ".join(f"at the {name} {of}" for name, of in said.items())
    constants, counts = next(iter(rest.values())).constants, {end.modes.unstable for end in rest.values()}
    reason += f"; 0 is the constant of {', '.join(constants)}, on which nothing depends" * bool(constants)
    if any(len(end.modes.on_axis) for end in rest.values()) or constants and counts == {0}:
        grows = grows or any(end.modes.unstable_beyond_axis for end in rest.values())
        return Verdict(GROWS if grows else MARGINAL, reason, **facts)
    if counts == {0}:
        return Verdict(GROWS if grows else MINIMUM, reason, **facts)
    return Verdict(HYPERBOLIC_ZEROS if len(counts) == 1 else GROWS, reason, **facts)


def _on_switch(model, motion, why):
    """The verdict where the program rests on a kink: by the growth along a run that leaves it."""
    if not isinstance(motion, Run):
        return Verdict(OPEN, why, f"pass a run that leaves it, along which errors are measured, or {SMOOTHER}")
    if stays_on_switch(model, motion):
        return Verdict(OPEN, f"{why}; the run stays there", f"{SMOOTHER}, or begin off it")
    internal = internal_dynamics(motion)
    return _along(internal, why, {"internal": internal})


def _along(internal, why, facts):
    """The verdict where the program never rests, by the growth along a run."""
    if internal is None:
        return Verdict(OPEN, f"no rest was found ({why})", "pass a run, along which errors are measured", **facts)
    words = {"stable": MINIMUM, "neutral": MARGINAL, "unstable": GROWS}
    word = words.get(internal.verdict, OPEN)
    do = "simulate with more samples (t_eval)" if word == OPEN else ""
    return Verdict(word, f"no rest ({why})", do, **facts)


def eigenvalues(end):
    """The eigenvalues of a rest in words, at most four of them."""
    zero = NOISE * np.abs(end.A * end.size / end.size[:, None]).max(initial=0.0)
    upper = [(0.0 if v in end.on_axis else v.real, v.imag) for v in end.eigenvalues if v.imag >= -zero]
    values = [f"{real:.6g}" + (f" ± {imag:.6g}i" if imag > zero else "") for real, imag in upper]
    more = f" and {len(values) - 4} more" if len(values) > 4 else ""
    return f"eigenvalues {', '.join(values[:4])}{more} 1/s"
