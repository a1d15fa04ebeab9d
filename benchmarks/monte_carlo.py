"""Monte Carlo: 2,000 loops of the overhead crane of 3 s at 1 kHz, with other masses and friction, on two threads.

Each gathers, over all samples, the largest size and the mean square of states and inputs; `close_many` those of the
program's residuals as well. RK4, one step per sample.
"""

from functools import cache

import numpy as np
from harness import Missing, Row, installed
from loop import DAMPING, M_LOAD, RATE, G, loop, rates
from native import COMPILER, build, casadi_text

import servoctl as sv

RUNS, END, THREADS = 2000, 3.0, 2
SINGLE = 32  # runs that are closed one by one
WITHIN, LOOSER = 1e-12, 1e-9
SIGNALS = ("x", "l", "theta", "dx", "dl", "dtheta", "trolley", "hoist")


@cache
def cases():
    """Loads and frictions of the runs."""
    rng = np.random.default_rng(7)
    spread = {"m_load": M_LOAD, "damping x": DAMPING["x"], "damping l": DAMPING["l"]}
    return {name: value * rng.uniform(0.85, 1.15, RUNS) for name, value in spread.items()}


def parameters():
    return np.array([*cases().values()])


def ours():
    plant, law, x0, *_ = loop(END)

    def call():
        run = sv.close(plant, law, x0, (0.0, END), timing=sv.Timing(substeps=1))
        many = sv.close_many(run, cases(), executor=THREADS)
        largest = [many[f"max |{name}|"] for name in SIGNALS]
        return np.array([*largest, *(many[f"rms {name}"] ** 2 for name in SIGNALS)])

    return call


def one_by_one():
    """The same of the first runs by `close`, (16, SINGLE)."""
    plant, law, x0, *_ = loop(END)
    found = np.empty((16, SINGLE))
    for i in range(SINGLE):
        m, c_x, c_l = parameters()[:, i]
        own = sv.plant(plant.mechanism, m_load=m, damping={"x": c_x, "l": c_l})
        run = sv.close(own, law, x0, (0.0, END), timing=sv.Timing(substeps=1))
        values = np.vstack([run.states, run.inputs])
        found[:, i] = [*np.abs(values).max(axis=1), *np.mean(values**2, axis=1)]
    return found


# peers: (16, RUNS) ---------------------------------------------------------------------------------------------------


def numpy_loops():
    """All runs side by side in arrays."""
    _, _, x0, u_ff, reference, K = loop(END)
    m, c_x, c_l = parameters()
    h = 1 / RATE

    def call():
        x = np.repeat(x0[:, None], RUNS, axis=1)
        largest, squares, count = np.zeros((8, RUNS)), np.zeros((8, RUNS)), u_ff.shape[1]
        for k in range(count):
            u = u_ff[:, k, None] - K @ (x - reference[:, k, None])
            values = np.vstack([x, u])
            np.maximum(largest, np.abs(values), out=largest)
            squares += values * values
            if k == count - 1:
                break
            k1 = rates(x, u, m, c_x, c_l)
            k2 = rates(x + h / 2 * k1, u, m, c_x, c_l)
            k3 = rates(x + h / 2 * k2, u, m, c_x, c_l)
            k4 = rates(x + h * k3, u, m, c_x, c_l)
            x = x + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        return np.vstack([largest, squares / count])

    return call


def casadi_map():
    """CasADi's own: the loop as a fold of the step, compiled, mapped over the runs on threads."""
    import casadi as ca

    plant, _, x0, u_ff, reference, K = loop(END)
    ode = plant.function("ode").expression
    t, x, p = ode.sx_in()
    numbers = ca.SX(plant.p())
    own, largest, squares = ca.SX.sym("own", 3), ca.SX.sym("largest", 8), ca.SX.sym("squares", 8)
    names = plant.mechanism.parameters.names
    numbers[names.index("m_load")], numbers[len(names)], numbers[len(names) + 1] = own[0], own[1], own[2]
    row = ca.SX.sym("row", 8)
    u = row[:2] - ca.DM(K) @ (x - row[2:])
    numbers[len(plant.parameters) : len(plant.parameters) + 2] = u
    h = 1 / RATE

    def rate(x):
        return ode(0, x, numbers)

    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    values = ca.vertcat(x, u)
    gathered = [ca.fmax(largest, ca.fabs(values)), squares + values * values]
    state = ca.vertcat(x, own, largest, squares)
    after = ca.vertcat(x + h / 6 * (k1 + 2 * (k2 + k3) + k4), own, *gathered)
    step = ca.Function("step", [state, row], [ca.cse(after)])
    count = u_ff.shape[1]
    start = ca.MX.sym("start", 25)
    run = ca.Function("run", [start], [step.fold(count)(start, ca.DM(np.vstack([u_ff, reference])))])
    compiled = ca.external("run", str(build(casadi_text(run), "-O3")))
    many = compiled.map(RUNS, "thread", THREADS)
    given = np.vstack([np.repeat(x0[:, None], RUNS, axis=1), parameters(), np.zeros((16, RUNS))])

    def call():
        found = many(given).full()[9:]
        return np.vstack([found[:8], found[8:] / count])

    return call


def numba_loops():
    """Scalars by hand, one run after the other on each thread."""
    import numba
    from loop import M_HOIST, M_TROLLEY

    _, _, x0, u_ff, reference, K = loop(END)
    numba.set_num_threads(THREADS)

    @numba.njit(fastmath=True, inline="always")
    def rate(l, theta, dx, dl, dtheta, u0, u1, m, c_x, c_l):
        s, c = np.sin(theta), np.cos(theta)
        w = m * (l * dtheta * dtheta + G * c)
        along, up, ms, m_l = u0 - c_x * dx + s * w, u1 - c_l * dl + w, m * s, M_HOIST + m
        scale = 1 / (M_TROLLEY * m_l + ms * s * M_HOIST)
        ddx = (along * m_l - ms * up) * scale
        ddl = ((M_TROLLEY + ms * s) * up - ms * along) * scale
        return ddx, ddl, -(ddx * c + 2 * dl * dtheta + G * s) / l

    @numba.njit(fastmath=True, parallel=True)
    def run(x0, rows, references, K, p, out):
        h = 1 / RATE
        count = rows.shape[0]
        for i in numba.prange(p.shape[1]):
            m, c_x, c_l = p[0, i], p[1, i], p[2, i]
            x, l, a, v, w, b = x0[0], x0[1], x0[2], x0[3], x0[4], x0[5]
            largest, squares = np.zeros(8), np.zeros(8)
            for k in range(count):
                r = references[k]
                e0, e1, e2, e3, e4, e5 = x - r[0], l - r[1], a - r[2], v - r[3], w - r[4], b - r[5]
                u0 = rows[k, 0] - (
                    K[0, 0] * e0 + K[0, 1] * e1 + K[0, 2] * e2 + K[0, 3] * e3 + K[0, 4] * e4 + K[0, 5] * e5
                )
                u1 = rows[k, 1] - (
                    K[1, 0] * e0 + K[1, 1] * e1 + K[1, 2] * e2 + K[1, 3] * e3 + K[1, 4] * e4 + K[1, 5] * e5
                )
                for j, value in enumerate((x, l, a, v, w, b, u0, u1)):
                    largest[j] = max(largest[j], abs(value))
                    squares[j] += value * value
                if k == count - 1:
                    break
                p1, q1, r1 = rate(l, a, v, w, b, u0, u1, m, c_x, c_l)
                v2, w2, b2 = v + h / 2 * p1, w + h / 2 * q1, b + h / 2 * r1
                p2, q2, r2 = rate(l + h / 2 * w, a + h / 2 * b, v2, w2, b2, u0, u1, m, c_x, c_l)
                v3, w3, b3 = v + h / 2 * p2, w + h / 2 * q2, b + h / 2 * r2
                p3, q3, r3 = rate(l + h / 2 * w2, a + h / 2 * b2, v3, w3, b3, u0, u1, m, c_x, c_l)
                v4, w4, b4 = v + h * p3, w + h * q3, b + h * r3
                p4, q4, r4 = rate(l + h * w3, a + h * b3, v4, w4, b4, u0, u1, m, c_x, c_l)
                x += h / 6 * (v + 2 * (v2 + v3) + v4)
                l += h / 6 * (w + 2 * (w2 + w3) + w4)
                a += h / 6 * (b + 2 * (b2 + b3) + b4)
                v += h / 6 * (p1 + 2 * (p2 + p3) + p4)
                w += h / 6 * (q1 + 2 * (q2 + q3) + q4)
                b += h / 6 * (r1 + 2 * (r2 + r3) + r4)
            for j in range(8):
                out[j, i], out[8 + j, i] = largest[j], squares[j] / count

    rows, references, K, p = (np.ascontiguousarray(values) for values in (u_ff.T, reference.T, K, parameters()))
    x0 = np.array(x0)

    def call():
        out = np.empty((16, RUNS))
        run(x0, rows, references, K, p, out)
        return out

    return call


def loops():
    exact = one_by_one()
    peers = {
        "casadi map, compiled": casadi_map() if COMPILER else Missing("gcc is not installed"),
        "numpy, vectorised over runs": numpy_loops(),
        "numba prange": numba_loops() if installed("numba") else Missing("numba is not installed"),
    }
    return Row(
        "2,000 loops of the crane, 3 s at 1 kHz, two threads",
        ours() if COMPILER else Missing("gcc is not installed"),
        peers,
        lambda found: np.abs(found[:, :SINGLE] / exact - 1).max(),
        WITHIN,
        dict(zip(peers, (8, 18, 4), strict=True)),
        dict.fromkeys(peers, LOOSER),
    )


ROWS = {"monte-carlo": loops}
