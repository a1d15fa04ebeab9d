"""The same run and the same report from other words: names, order, units, quasi-velocities, equivalent constraints."""

from dataclasses import dataclass, field
from functools import cache

import casadi as ca
import numpy as np
import pytest

import servoctl as sv

ALPHA = np.pi / 4


@dataclass(frozen=True)
class Words:
    """How a system is written down; `unit` is the number of length units in a metre."""

    prefix: str = ""
    order: tuple = ()
    unit: float = 1.0
    frame: bool = False
    residuals: object = field(default=None, hash=False, compare=False)

    def coordinates(self, names, velocities="", V=None):
        """Coordinates in this order under these names, and their symbols by the names of the plain system."""
        names = names.split()
        order = self.order or tuple(range(len(names)))
        q = sv.coordinates(" ".join(self.prefix + names[i] for i in order))
        symbols = {names[i]: s for i, s in zip(order, q, strict=True)}
        if self.frame:
            q = q.with_quasi_velocities(velocities, [V(symbols)[i] for i in order])
        return q, symbols

    def rates(self, q, names, k):
        """k-th derivatives by the names of the plain system."""
        names = names.split()
        order = self.order or tuple(range(len(names)))
        found = dict(zip((names[i] for i in order), q.d(k), strict=True))
        return [found[name] for name in names]

    def derived(self, q, mechanism, residuals, **options):
        residuals = residuals if self.residuals is None else self.residuals(q, residuals)
        return sv.derive(mechanism, sv.Program(residuals, **options))


def crane(w):
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81 * w.unit)
    q, s = w.coordinates(
        "x l theta", "u v w", lambda s: [[1 + s["theta"] ** 2, 0.3, 0], [0, 2, 0.1], [0.1 / w.unit, 0, 1 / w.unit]]
    )
    x, l, theta = s["x"], s["l"], s["theta"]
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))
    start, end = (0.0, 4.0 * w.unit), (5.0 * w.unit, 2.0 * w.unit)
    path = sv.paths.rest_to_rest(start, end, duration=6.0, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    S = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load)
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=-p.m_load * p.g * load[1], actuators={"trolley": x, "hoist": l}, parameters=p
    )
    model = w.derived(q, mechanism, {"X": load[0] - r.X, "Z": load[1] - r.Z})
    return model, {"guess": {w.prefix + "l": 4.0 * w.unit}}, 6.0, {"x": 1, "l": 1, "theta": 0, "trolley": 1, "hoist": 1}


def appell_hamel(w):
    L = w.unit
    p = sv.parameters(
        m=1.0, M=2.0, I_x=0.2 * L**2, I_y=0.25 * L**2, a=0.5 * L, b=0.2 * L, rho=0.3 * L, g=9.81 * L
    )  # fmt: skip
    names = "x y z phi theta"

    def rolling_frame(s):
        sine, cosine = ca.sin(s["theta"]), ca.cos(s["theta"])
        return [[cosine, -sine, 0, 0, 0], [sine, cosine, 0, 0, 0], [0, 0, 1, -p.b, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]

    q, s = w.coordinates(names, "forward side slack spin turn", rolling_frame)
    dx, dy, _, dphi, dtheta = w.rates(q, names, 1)
    ddx, ddy, ddz, ddphi, ddtheta = w.rates(q, names, 2)
    theta = s["theta"]
    S = (p.m * (ddx**2 + ddy**2 + ddz**2) + (p.I_y + p.a**2 * p.M) * ddphi**2 + p.I_x * ddtheta**2) / 2
    mechanism = sv.Mechanism(q, gibbs=S, potential=-p.m * p.g * s["z"], parameters=p)
    residuals = {
        "x_c": dx - p.a * dphi * ca.cos(theta) + p.rho * dtheta * ca.sin(theta),
        "y_c": dy - p.a * dphi * ca.sin(theta) - p.rho * dtheta * ca.cos(theta),
        "string": s["z"] + p.b * s["phi"],
    }
    start = {w.prefix + name: 0.0 for name in ("x", "y", "phi", "theta")}
    rates = {"spin": 1.0, "turn": 2.0} if w.frame else {f"d{w.prefix}phi": 1.0, f"d{w.prefix}theta": 2.0}
    signals = {"x": 1, "y": 1, "z": 1, "phi": 0, "theta": 0, "dx": 1, "dphi": 0, "dtheta": 0}
    return w.derived(q, mechanism, residuals, by="ideal"), start | rates, 2.0, signals


def mass_on_car(w):
    p = sv.parameters(m_1=1.0, m_2=2.0, k=5.0, d=1.0)
    q, sym = w.coordinates("x s", "u v", lambda s: [[1, 0.5], [-0.2, 2]])
    x, s = sym["x"], sym["s"]
    mass = ca.vertcat(x + s * np.cos(ALPHA), s * np.sin(ALPHA))
    _, ds = w.rates(q, "x s", 1)
    path = q.references(z=sv.paths.rest_to_rest(0.5 * w.unit, 2.5 * w.unit, duration=3.0, smoothness=6)).z
    column = q.V.T @ ca.gradient(s, ca.vertcat(*q))
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m_1, x) + sv.particle(q, p.m_2, mass),
        potential=p.k * s**2 / 2,
        forces=-p.d * ds * column,
        actuators={"force": x},
        parameters=p,
    )
    start = {w.prefix + "s": 0.0} | ({"u": 0.0} if w.frame else {f"d{w.prefix}s": 0.0})
    return w.derived(q, mechanism, {"z": mass[0] - path}), start, 4.0, {"x": 1, "s": 1, "ds": 1, "force": 1}


def spiral(w):
    p = sv.parameters(m=1.0, c=0.5 / w.unit)
    q, s = w.coordinates("x y", "u v", lambda s: [[ca.cos(s["y"] / w.unit), -ca.sin(s["y"] / w.unit)],
                                                  [ca.sin(s["y"] / w.unit), ca.cos(s["y"] / w.unit)]])  # fmt: skip
    (dx, dy), (ddx, ddy) = w.rates(q, "x y", 1), w.rates(q, "x y", 2)
    curvature = (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, ca.vertcat(s["x"], s["y"])), parameters=p)
    jets = ("u", "v", "du", "dv") if w.frame else [f"{d}{w.prefix}{name}" for d in ("d", "d2") for name in "xy"]
    values = dict(zip(jets, (w.unit, 0.0, 0.0, 0.0), strict=True))
    start = {f"{w.prefix}x": 0.0, f"{w.prefix}y": 0.0} | {k: v for k, v in values.items() if k != jets[2]}
    model = w.derived(q, mechanism, {"curvature": q.dt(curvature) - p.c}, by="ideal")
    return model, start, 2.0, {"x": 1, "y": 1, "dx": 1, "dy": 1}


SYSTEMS = {f.__name__: f for f in (crane, appell_hamel, mass_on_car, spiral)}


@cache
def plain(name):
    return SYSTEMS[name](Words())


@cache
def plain_motion(name):
    return motion(plain(name))


def motion(system, **options):
    model, start, duration, _ = system
    method = None if model.flat else sv.methods.Adaptive(rtol=1e-12, atol=1e-13)
    guess = start.get("guess")
    held = {k: v for k, v in start.items() if k != "guess"}
    state = options.pop("state", None) or model.start(guess=guess, **held)
    return sv.simulate(model, state, (0.0, duration), method, t_eval=np.linspace(0.0, duration, 41))


def report(model):
    """Orders, free initial values, index, zeros at infinity, essential orders, relative degrees."""
    s = model.structure()
    orders = sorted(row.order for row in model.reduction.rows)
    degrees = (s.index, s.zeros_at_infinity, s.essential_orders, s.relative_degree, s.decoupling_rank, s.realisation)
    return orders, model.free, degrees


def assert_same_motion(run, name, w=None, tolerance=1e-9):
    w, reference = w or Words(), plain_motion(name)
    for signal, lengths in plain(name)[3].items():
        stem = signal.removeprefix("d")
        own = signal if signal in run.model.actuators else signal[: len(signal) - len(stem)] + w.prefix + stem
        found = run[own] / w.unit**lengths
        size = 1.0 + np.abs(reference[signal]).max()
        assert np.max(np.abs(found - reference[signal])) < tolerance * size, signal


WORDS = {
    "permuted": {"order": "backwards"},
    "kilometres": {"unit": 1e-3},
    "quasi-velocities": {"frame": True},
    "all at once": {"prefix": "my_", "order": "backwards", "unit": 1e3, "frame": True},
}
SIZES = {"crane": 3, "appell_hamel": 5, "mass_on_car": 2, "spiral": 2}


@pytest.mark.parametrize(
    ("name", "kind"),
    [*((name, "all at once") for name in SYSTEMS), ("crane", "kilometres"), ("appell_hamel", "permuted"),
     ("spiral", "quasi-velocities")],
)
def test_same_motion_and_report_in_other_words(name, kind):
    w = Words(**WORDS[kind] | ({"order": tuple(reversed(range(SIZES[name])))} if "order" in WORDS[kind] else {}))
    system = SYSTEMS[name](w)
    assert report(system[0]) == report(plain(name)[0])
    assert_same_motion(motion(system), name, w)


# constraints ---------------------------------------------------------------------------------------------------------


def scaled(factor):
    return lambda q, residuals: {name: factor * e for name, e in residuals.items()}


def mixed(q, residuals):
    """Equivalent combinations with coefficients that depend on the state."""
    names, e = list(residuals), list(residuals.values())
    if len(e) == 1:
        return {names[0]: e[0] * (2 + ca.sin(q.d(0)[0]))}
    sine, cosine = ca.sin(q.d(0)[-1]), ca.cos(q.d(0)[-1])
    turned = [e[0] * cosine + e[1] * sine, e[1] * cosine - e[0] * sine]
    return dict(zip(names, [*turned, *e[2:]], strict=True))


def sums(q, residuals):
    """Equivalent combinations with constant coefficients, across orders where there are several."""
    names, e = list(residuals), list(residuals.values())
    others = [e[0] + 2 * e[1], e[1] - e[0], *e[2:]] if len(e) > 1 else [-3 * e[0]]
    return dict(zip(names, others, strict=True))


EQUIVALENT = {"times 1e6": scaled(1e6), "times 1e-6": scaled(1e-6), "mixed": mixed, "sums": sums}


@pytest.mark.parametrize(
    ("name", "how"),
    [("crane", "sums"), ("appell_hamel", "mixed"), ("mass_on_car", "times 1e6"), ("spiral", "times 1e-6")],
)
def test_equivalent_constraints_give_the_same_motion_and_report(name, how):
    system = SYSTEMS[name](Words(residuals=EQUIVALENT[how]))
    assert report(system[0]) == report(plain(name)[0])
    assert_same_motion(motion(system), name)


def differentiated(which):
    return lambda q, residuals: {name: q.dt(e) if name == which else e for name, e in residuals.items()}


@pytest.mark.parametrize(
    ("name", "which"),
    [
        ("crane", "X"), ("crane", "Z"), ("appell_hamel", "x_c"), ("appell_hamel", "string"), ("mass_on_car", "z"),
        ("spiral", "curvature"),
    ],
)  # fmt: skip
def test_a_differentiated_constraint_has_one_more_free_initial_value(name, which):
    system = SYSTEMS[name](Words(residuals=differentiated(which)))
    model, reference = system[0], plain(name)[0]
    assert model.free == reference.free + 1
    assert model.reduction.original[which].order == reference.reduction.original[which].order + 1
    first = plain_motion(name)
    jets = dict(zip(first.jet_names, first.jets[:, 0].tolist(), strict=True))
    state = model.start(guess={n: jets[n] for n in model.state_names})
    assert [state[n] for n in model.state_names] == pytest.approx([jets[n] for n in model.state_names], abs=1e-9)
    assert_same_motion(motion(system, state=state), name, tolerance=1e-8)
