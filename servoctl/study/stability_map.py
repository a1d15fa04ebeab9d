"""The largest stable step of every method along a plan, from the linearised step map.

Near the manifold of the constraints the state splits in two. *Along* it move the Σ o_a internal states, which
`internal_dynamics` linearises. *Off* it, the residual ψ of a row that was differentiated ρ times obeys the error
dynamics of the drift treatment, whatever the motion: D^ρ ψ = 0 (ρ neutral eigenvalues), Π(D - λ) ψ = 0 (the poles), or
ψ = 0 (projection). One step multiplies a mode of eigenvalue λ by R(hλ), the method's stability
function.
"""

import numpy as np

from servoctl.checks import named, positives, require_kind
from servoctl.errors import SpecificationError
from servoctl.growth import linearised
from servoctl.markup import Shown
from servoctl.methods.choice import ORDERS, Poles, as_drift
from servoctl.methods.stability import STEP_MAPS, amplification, stability_function
from servoctl.model.model import Model
from servoctl.run import Run
from servoctl.values import frozen

MAPPED = (*ORDERS, "Taylor", "RadauIIA")
RADAU_ORDER = 5  # default; all orders are L-stable
PLAN_INSTANTS = 101  # instants at which eigenvalues are computed: on smooth plans neighbours differ little
GROWTH = 2.0  # growth of errors over the plan that counts as stable: neutral modes and rounding stay below it
PER_DECADE, DECADES = 30, 7  # steps tried, below the length of the plan


@frozen(eq=False)
class StabilityMap(Shown):
    """The stable steps along a plan; made by `stability`.

    In all methods, `method` is "RK4", "RK8", "RK45", "DOP853", "Taylor", "RadauIIA" or "Radau", `drift` is a
    treatment as in `simulate`, and `order` is that of "Taylor" (default: the map's) and of "RadauIIA" (default: 5).

    Attributes
    ----------
    t : (N,) array
        Instants of the plan [s].
    rates : (N, f) array of complex
        Eigenvalues of the internal dynamics at these instants [1/s], f = Σ o_a.
    model : Model
    order : int
        Default order of "Taylor".
    """

    t: np.ndarray
    rates: np.ndarray
    model: object
    order: int

    def eigenvalues(self, drift=None):
        """Eigenvalues [1/s] of all directions that count under a drift treatment, (N, f + poles).

        Parameters
        ----------
        drift : None, "project", float, `sv.methods.Project(...)` or `sv.methods.Poles(...)`, optional
            Constraint violations count where poles govern them: without treatment they are neutral under every method,
            and projection removes them.
        """
        drift = as_drift(drift)
        if not isinstance(drift, Poles):
            return self.rates
        drift.coefficients(self.model)  # refuses poles that do not fit the rows
        poles = np.concatenate([*drift.by_row(self.model).values(), np.zeros(0)])
        return np.hstack([self.rates, np.broadcast_to(poles, (len(self.t), len(poles)))])

    def radius(self, method, step, drift=None, order=None):
        """Spectral radius of the step map at each instant, relative to the growth of the motion itself.

        Parameters
        ----------
        method : str
        step : float or (K,) array
            [s]
        drift, order : optional

        Returns
        -------
        (N,) or (K, N) array
            max |R(hλ)| / max(1, |e^hλ|)
        """
        named(method, STEP_MAPS, "method")
        step = positives("step", step, do="Give it in seconds, such as 1e-3.")
        z = np.multiply.outer(step, self.eigenvalues(drift))
        if order is None:
            order = {"Taylor": self.order, "RadauIIA": RADAU_ORDER}.get(method)
        motion = np.exp(np.clip(z.real, 0.0, 700.0))
        return (amplification(method, z, order) / motion).max(axis=-1, initial=0.0)

    def growth(self, method, step, drift=None, order=None):
        """Bound on the growth of errors over the plan, beyond that of the motion itself.

        Parameters
        ----------
        method : str
        step : float or (K,) array
            [s]
        drift, order : optional

        Returns
        -------
        float or (K,) array
            exp ∫ ln max(1, radius) dt / h, by the trapezoidal rule
        """
        with np.errstate(over="ignore"):
            logarithm = np.log(np.maximum(self.radius(method, step, drift, order), 1.0))
            return np.exp((logarithm[..., 1:] + logarithm[..., :-1]) @ np.abs(np.diff(self.t)) / 2 / step)

    def largest_step(self, method, drift=None, order=None):
        """The largest stable step [s]: with it and all shorter ones errors grow at most twofold over the plan.

        Parameters
        ----------
        method : str
            The step control of an adaptive method settles near this step.
        drift, order : optional

        Returns
        -------
        float
            inf if no step up to the length of the plan is unstable.

        Raises
        ------
        NameUnknown
            For other methods.
        SpecificationError
            For poles that do not fit the rows.
        """
        length = abs(self.t[-1] - self.t[0])
        steps = length * 10.0 ** (-np.arange(DECADES * PER_DECADE, -1, -1) / PER_DECADE)
        unstable = np.flatnonzero(self.growth(method, steps, drift, order) > GROWTH)
        if not len(unstable):
            return np.inf
        low, high = (steps[unstable[0] - 1] if unstable[0] else 0.0), steps[unstable[0]]
        while low > 0.0 and high - low > 1e-6 * high:
            middle = (low + high) / 2
            low, high = (low, middle) if self.growth(method, middle, drift, order) > GROWTH else (middle, high)
        return float(low)

    def plot(self, method="RK4", poles=None):
        """Draw the largest steps over the poles, and the spectral radius of one method over poles and steps.

        Parameters
        ----------
        method : str
            The method whose spectral radius is drawn.
        poles : (K,) array, optional
            Magnitudes 1/T of the poles [1/s], two or more; default: 3 to 3,000 per length of the plan.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from servoctl.figures.stability import draw_stability

        named(method, STEP_MAPS, "method")
        if poles is not None:
            do = "Give them in 1/s, such as numpy.geomspace(1, 100, 41)."
            poles = np.sort(np.ravel(positives("poles", poles, do, fewest=2)))
        return draw_stability(self, method, poles, (*ORDERS, "Taylor"))

    def __repr__(self):
        raised = ", ".join(f"{row} {count}x" for row, count in self.model.reduction.raised.items() if count)
        raised = raised or "none: no row was differentiated"
        drifts = [None, 1.0, 0.1, 0.01]  # time constants of poles [s]
        lines = [
            f"Stability along the plan: t = {self.t[0]:g} .. {self.t[-1]:g} s at {len(self.t)} instants",
            f"  along the manifold: {self._internal()}",
            f"  off the manifold: {raised}; neutral without treatment, at the poles with, removed by projection",
            f"  largest step [s] {'no poles':>12}" + "".join(f"{f'T = {T:g} s':>12}" for T in drifts[1:]),
        ]
        for method in MAPPED:
            name = f"Taylor {self.order}" if method == "Taylor" else method
            steps = (self.largest_step(method, drift) for drift in drifts)
            lines.append(f"  {name:<16} " + "".join(f"{_step_text(step):>12}" for step in steps))
        return "\n".join(lines)

    def _internal(self):
        if not self.rates.shape[1]:
            return "nothing moves, the program determines the motion"
        fastest, growing = np.abs(self.rates).max(), self.rates.real.max()
        text = f"{self.rates.shape[1]} internal states; |λ| up to {fastest:.4g} 1/s"
        return text + (f", growth {growing:.4g} 1/s is the motion's own" if growing > 1e-6 * (1 + fastest) else "")


def stability(model: Model, run: Run, order: int = 12) -> StabilityMap:
    """The largest stable steps of all methods and drift treatments along a plan.

    Parameters
    ----------
    model : Model
    run : Run
        A motion of this model.
    order : int
        Order of the Taylor method.

    Returns
    -------
    StabilityMap

    Raises
    ------
    SpecificationError
        If the run is not a motion of this model, or the Jacobian is finite at fewer than two instants of it.

    Notes
    -----
    Coefficients are frozen at each instant: eigenvalues are uncertain by the rate at which the manifold turns along the
    motion. Far from the imaginary axis, where steps become unstable, this matters little.
    """
    require_kind(Model, "model", model, "sv.derive(mechanism, program)")
    stability_function("Taylor", order)
    names = tuple(getattr(run, "jet_names", ()))[: len(model.state_names)]
    if names != tuple(model.state_names) or len(run.t) < 2:
        raise SpecificationError(
            f"The run has {len(run.t)} samples of {', '.join(names)}." if names else f"run={run!r} was given.",
            f"The plan must be a motion of the model, whose state is {', '.join(model.state_names)}.",
            do="Give the run that simulate(model, ...) returned.",
            names=names,
            expected=tuple(model.state_names),
        )
    t, matrices = linearised(model, run, PLAN_INSTANTS)
    if len(t) < 2:
        raise SpecificationError(
            f"The Jacobian of the motion is finite at {len(t)} instants of the run.",
            "The linearised motion is needed at two instants or more.",
            do="Check the run by verify(run).",
            instants=len(t),
        )
    return StabilityMap(t, np.linalg.eigvals(matrices).astype(complex), model, order)


def _step_text(step):
    return "any" if np.isinf(step) else "none" if step == 0.0 else f"{step:.4g}"
