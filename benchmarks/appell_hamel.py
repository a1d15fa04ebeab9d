"""The Appell-Hamel mechanism for 10 s, to a given error of (q, q') at the end.

The wheel stops and turns back on the way. Peers get the equations that an expert reduces by hand, 7 of first order (all
but the one who solves the multiplier form); we get the mechanism and its constraints. For everyone the fastest setting
that meets the error is taken.
"""

import ctypes
from functools import cache, partial
from math import cos, sin

import casadi as ca
import numpy as np
from harness import Missing, Row, fastest, installed
from native import COMPILER, build, function

import servoctl as sv
from servoctl.gallery import appell_hamel
from servoctl.methods.taylor import series_loop

DURATION = 10.0  # s
P = {"m": 1.0, "M": 5.0, "I_x": 0.1125, "I_y": 0.225, "a": 0.3, "b": 0.1, "rho": 0.2, "g": 9.81}
START = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5])  # x, y, z, phi, theta, dphi, dtheta
SAMPLES = np.linspace(0.0, DURATION, 1001)  # s, where everyone samples whose task is all of a motion
END = np.array([  # q and q' after 10 s, by Taylor series with 36 digits in steps of 1/12 s
    -0.44835649274707243903, -0.20933209194435088135, 0.027821834322839303383, -0.27821834322839303383,
    23.079096330954109295, 0.28001478686948064541, 0.29384732517668349717, 0.13008849162553147637,
    -1.3008849162553147637, 0.55783936976513418146,
])  # fmt: skip

# The reduced equations: dphi' = (along dtheta^2 - weight)/A, dtheta' = -along dphi dtheta/B.
ALONG, WEIGHT = P["m"] * P["a"] * P["rho"], P["b"] * P["m"] * P["g"]
A = P["I_y"] + P["a"] ** 2 * (P["M"] + P["m"]) + P["b"] ** 2 * P["m"]
B = P["I_x"] + P["m"] * P["rho"] ** 2


def error(state):
    """Of (q, q'), from all of it or from the 7 reduced states, with w_z where there are 8."""
    state = np.ravel(state)
    state = np.delete(state, 5) if len(state) == 8 else state
    return np.abs((state if len(state) == 10 else full(state)) - END).max()


def full(state):
    theta, dphi, dtheta = state[4:]
    s, c = np.sin(theta), np.cos(theta)
    dx, dy = P["a"] * dphi * c - P["rho"] * dtheta * s, P["a"] * dphi * s + P["rho"] * dtheta * c
    return np.array([*state[:5], dx, dy, -P["b"] * dphi, dphi, dtheta])


# ours ----------------------------------------------------------------------------------------------------------------


@cache
def constrained():
    """Model and start of the mechanism under its linear constraints, as in the gallery."""
    model = sv.derive(*appell_hamel()).with_parameters(**P)
    start = model.start(x=0.0, y=0.0, phi=0.0, theta=0.0, dphi=START[5], dtheta=START[6])
    return model, start


@cache
def rolling():
    """The same with rolling in the quasi-velocities (z', phi', theta'); the string alone is a program."""
    p = sv.parameters(**P)
    q = sv.coordinates("x y z phi theta")
    _, _, z, phi, theta = q
    s, c = ca.sin(theta), ca.cos(theta)
    V = [[0, p.a * c, -p.rho * s], [0, p.a * s, p.rho * c], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    q = q.with_quasi_velocities("w_z w_phi w_theta", V)
    w_z, w_phi, w_theta = q.w(0)
    dw_z, dw_phi, dw_theta = q.w(1)
    S = p.m * dw_z**2 + (p.I_y + p.a**2 * (p.M + p.m)) * dw_phi**2 + (p.I_x + p.m * p.rho**2) * dw_theta**2
    S = S / 2 + p.m * p.a * p.rho * (w_phi * w_theta * dw_theta - w_theta**2 * dw_phi)
    mechanism = sv.Mechanism(q, gibbs=S, potential=-p.m * p.g * z, parameters=p)
    model = sv.derive(mechanism, sv.Program({"string": z + p.b * phi}, by="ideal"))
    return model, model.start(x=0.0, y=0.0, phi=0.0, theta=0.0, w_phi=START[5], w_theta=START[6])


def taylor(scene, last, rtol):
    model, start = scene()
    f, x0 = series_loop(model, last), start.values
    p = np.append(model.parameters, DURATION / 2)

    def call():
        return f.taylor(0.0, x0, DURATION, p, rtol, rtol, 200)[-1, 1 : 1 + len(x0)]

    return call


def simulated(order, rtol):
    model, start = constrained()

    def call():
        method = sv.methods.Taylor(order, rtol=rtol, atol=rtol)
        run = sv.simulate(model, start, (0.0, DURATION), method, t_eval=SAMPLES, progress=False)
        return run.jets[:10, -1]

    return call


# peers ---------------------------------------------------------------------------------------------------------------


def rates(_, state):
    theta, dphi, dtheta = state[4:]
    s, c = np.sin(theta), np.cos(theta)
    return np.array([
        0.3 * dphi * c - 0.2 * dtheta * s, 0.3 * dphi * s + 0.2 * dtheta * c, -0.1 * dphi, dphi, dtheta,
        (ALONG * dtheta**2 - WEIGHT) / A, -ALONG / B * dphi * dtheta,
    ])  # fmt: skip


def float_rates(_, state):
    """The same with Python's floats, which are faster for single numbers."""
    _, _, _, _, theta, dphi, dtheta = state.tolist()
    s, c = sin(theta), cos(theta)
    return (
        0.3 * dphi * c - 0.2 * dtheta * s, 0.3 * dphi * s + 0.2 * dtheta * c, -0.1 * dphi, dphi, dtheta,
        (ALONG * dtheta * dtheta - WEIGHT) / A, -ALONG / B * dphi * dtheta,
    )  # fmt: skip


def scipy_adaptive(method, f, x0, rtol, times=None):
    from scipy.integrate import solve_ivp

    return lambda: solve_ivp(f, (0.0, DURATION), x0, method=method, rtol=rtol, atol=rtol, t_eval=times).y[:, -1]


def scipy_odeint(f, rtol, times=None):
    from scipy.integrate import odeint

    times = (0.0, DURATION) if times is None else times
    return lambda: odeint(f, START, times, rtol=rtol, atol=rtol, tfirst=True, mxstep=5000)[-1]


def multiplier_rates():
    """q'' from [M -J^T; J 0] (q'', multipliers) = (Q, -dJ/dt q'), with only the entries that change written anew."""
    matrix, right = np.zeros((8, 8)), np.zeros(8)
    matrix[range(5), range(5)] = P["m"], P["m"], P["m"], P["I_y"] + P["a"] ** 2 * P["M"], P["I_x"]
    matrix[[5, 6, 7], [0, 1, 2]], matrix[[0, 1, 2], [5, 6, 7]] = 1.0, -1.0
    matrix[7, 3], matrix[3, 7] = P["b"], -P["b"]
    right[2] = P["m"] * P["g"]
    a, rho = P["a"], P["rho"]

    def f(_, x):
        _, _, _, _, theta, _, _, _, dphi, dtheta = x.tolist()
        s, c = sin(theta), cos(theta)
        matrix[5:7, 3:5] = (-a * c, rho * s), (-a * s, -rho * c)
        matrix[3:5, 5:7] = (a * c, a * s), (-rho * s, rho * c)
        right[5] = -(a * dphi * s * dtheta + rho * dtheta * dtheta * c)
        right[6] = a * dphi * c * dtheta - rho * dtheta * dtheta * s
        return np.concatenate([x[5:], np.linalg.solve(matrix, right)[:5]])

    return f


def casadi_cvodes(multistep, rtol, times=None):
    x = ca.SX.sym("x", 7)
    _, _, _, _, theta, dphi, dtheta = ca.vertsplit(x)
    s, c = ca.sin(theta), ca.cos(theta)
    ode = ca.vertcat(
        0.3 * dphi * c - 0.2 * dtheta * s, 0.3 * dphi * s + 0.2 * dtheta * c, -0.1 * dphi, dphi, dtheta,
        (ALONG * dtheta**2 - WEIGHT) / A, -ALONG / B * dphi * dtheta,
    )  # fmt: skip
    options = {"reltol": rtol, "abstol": rtol, "linear_multistep_method": multistep, "max_num_steps": 100000}
    F = ca.integrator("F", "cvodes", {"x": x, "ode": ode}, 0.0, DURATION if times is None else times, options)
    return lambda: F(x0=START)["xf"].full()[:, -1]


RK4 = """
#include <math.h>
static inline void rates(const double *x, double *f)
{
    const double s = sin(x[4]), c = cos(x[4]), dphi = x[5], dtheta = x[6];
    f[0] = 0.3 * dphi * c - 0.2 * dtheta * s;
    f[1] = 0.3 * dphi * s + 0.2 * dtheta * c;
    f[2] = -0.1 * dphi;
    f[3] = dphi;
    f[4] = dtheta;
    f[5] = PHI_1 * dtheta * dtheta - PHI_0;
    f[6] = -THETA_1 * dphi * dtheta;
}
void rk4(double *x, double h, long steps)
{
    double k1[7], k2[7], k3[7], k4[7], y[7];
    for (long step = 0; step < steps; step++) {
        rates(x, k1);
        for (int i = 0; i < 7; i++) y[i] = x[i] + h / 2 * k1[i];
        rates(y, k2);
        for (int i = 0; i < 7; i++) y[i] = x[i] + h / 2 * k2[i];
        rates(y, k3);
        for (int i = 0; i < 7; i++) y[i] = x[i] + h * k3[i];
        rates(y, k4);
        for (int i = 0; i < 7; i++) x[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
    }
}
"""


@cache
def rk4_library():
    constants = {"PHI_1": ALONG / A, "PHI_0": WEIGHT / A, "THETA_1": ALONG / B}
    return build(RK4, "-O3", "-ffast-math", *(f"-D{name}={value!r}" for name, value in constants.items()))


def c_rk4(steps):
    f = function(rk4_library(), "rk4", ctypes.c_void_p, ctypes.c_double, ctypes.c_long)
    x = START.copy()
    address = x.ctypes.data

    def call():
        x[:] = START
        f(address, DURATION / steps, steps)
        return x

    return call


def heyoka_taylor(tolerance, times=None):
    import heyoka as hy

    x, y, z, phi, theta, dphi, dtheta = hy.make_vars("x", "y", "z", "phi", "theta", "dphi", "dtheta")
    s, c = hy.sin(theta), hy.cos(theta)
    system = [
        (x, 0.3 * dphi * c - 0.2 * dtheta * s), (y, 0.3 * dphi * s + 0.2 * dtheta * c), (z, -0.1 * dphi),
        (phi, dphi), (theta, dtheta),
        (dphi, ALONG / A * dtheta * dtheta - WEIGHT / A), (dtheta, -ALONG / B * dphi * dtheta),
    ]  # fmt: skip
    integrator = hy.taylor_adaptive(system, START, tol=tolerance)

    def call():
        integrator.time = 0.0
        integrator.state[:] = START
        if times is not None:
            return integrator.propagate_grid(times)[-1][-1]
        integrator.propagate_until(DURATION)
        return integrator.state

    return call


# rows ----------------------------------------------------------------------------------------------------------------


def ladder(coarse, fine, per_decade=2):
    """Tolerances 10^-coarse .. 10^-fine."""
    return [(10 ** (-k / per_decade),) for k in range(per_decade * coarse, per_decade * fine + 1)]


def heyoka_peer(tolerances, within, times=None):
    if not installed("heyoka"):
        return Missing("heyoka is not installed")
    return fastest(partial(heyoka_taylor, times=times), tolerances, error, within)


def coarse_peers(times=None):
    """Name: peer, each with its fastest setting for 1e-6; with samples at some times where these are given."""
    best = partial(fastest, error=error, within=1e-6)
    tolerances, start = ladder(5, 10), np.concatenate([START[:5], full(START)[5:]])
    by_hand = {"in NumPy": rates, "in Python's floats": float_rates}
    return {
        f"scipy {name}, 7 equations by hand, {how}": best(make(f), tolerances)
        for how, f in by_hand.items()
        for name, make in {
            "DOP853": lambda f: partial(scipy_adaptive, "DOP853", f, START, times=times),
            "LSODA": lambda f: partial(scipy_adaptive, "LSODA", f, START, times=times),
            "odeint (LSODA)": lambda f: partial(scipy_odeint, f, times=times),
        }.items()
    } | {
        "scipy DOP853, multiplier form in NumPy": best(
            partial(scipy_adaptive, "DOP853", multiplier_rates(), start, times=times), tolerances
        ),
        "casadi cvodes, 7 equations by hand": best(
            partial(casadi_cvodes, times=times),
            [(method, rtol) for method in ("adams", "bdf") for (rtol,) in tolerances],
        ),
        "heyoka, 7 equations by hand": heyoka_peer(ladder(4, 8), 1e-6, times),
    }


def c_peer():
    """RK4 in C, which keeps the end alone."""
    if not COMPILER:
        return Missing("gcc is not installed")
    return fastest(c_rk4, [(n,) for n in range(150, 651, 50)], error, 1e-6)


COARSE_BARS = {
    "scipy DOP853, 7 equations by hand, in NumPy": 60, "scipy LSODA, 7 equations by hand, in NumPy": 60,
    "scipy odeint (LSODA), 7 equations by hand, in NumPy": 60, "scipy DOP853, multiplier form in NumPy": 200,
    "casadi cvodes, 7 equations by hand": 50, "C, RK4 by hand, -O3 -ffast-math": 1,
}  # fmt: skip
SIMULATED_BARS = {
    "scipy DOP853, 7 equations by hand, in NumPy": 25, "casadi cvodes, 7 equations by hand": 4,
}  # fmt: skip
FINE_BARS = {"scipy DOP853, our compiled right-hand side": 20}
HEYOKA_BARS = {constrained: {"heyoka, 7 equations by hand": 1.0}, rolling: {"heyoka, 7 equations by hand": 1.3}}
COARSE = [(last, rtol) for last in range(8, 19, 2) for (rtol,) in ladder(4, 7)]
FINE = [(last, rtol) for last in range(16, 25, 2) for (rtol,) in ladder(11, 14)]


def fine_peers():
    """Name: peer, each with its fastest setting for 1e-12."""
    model, start = constrained()
    f, p = model.function("ode"), model.parameters
    buffered = partial(scipy_adaptive, "DOP853", lambda t, x: f(t, x, p)[:10], start.values)
    return {
        "scipy DOP853, our compiled right-hand side": fastest(buffered, ladder(11, 13, 4), error, 1e-12),
        "heyoka, 7 equations by hand": heyoka_peer(ladder(10, 15), 1e-12),
    }


def coarse(scene, title):
    ours = fastest(partial(taylor, scene), COARSE, error, 1e-6)
    peers = coarse_peers() | {"C, RK4 by hand, -O3 -ffast-math": c_peer()}
    return Row(f"Appell-Hamel 10 s, error 1e-6: {title}", ours, peers, error, 1e-6, COARSE_BARS | HEYOKA_BARS[scene])


def coarse_simulated():
    settings = [(None, rtol) for (rtol,) in ladder(4, 7)] + [(order, rtol) for order, rtol in COARSE if order > 8]
    ours = fastest(simulated, settings, error, 1e-6)
    title = "Appell-Hamel 10 s, error 1e-6: all of sv.simulate, 1,001 samples"
    return Row(title, ours, coarse_peers(SAMPLES), error, 1e-6, SIMULATED_BARS)


def fine(scene, title):
    ours = fastest(partial(taylor, scene), FINE, error, 1e-12)
    bars = FINE_BARS | HEYOKA_BARS[scene]
    return Row(f"Appell-Hamel 10 s, error 1e-12: {title}", ours, fine_peers(), error, 1e-12, bars)


ROWS = {
    "appell-hamel-1e-6": partial(coarse, constrained, "one call, constraints as given"),
    "appell-hamel-1e-6-rolling": partial(coarse, rolling, "one call, rolling as quasi-velocities"),
    "appell-hamel-1e-6-simulate": coarse_simulated,
    "appell-hamel-1e-12": partial(fine, constrained, "one call, constraints as given"),
    "appell-hamel-1e-12-rolling": partial(fine, rolling, "one call, rolling as quasi-velocities"),
}
