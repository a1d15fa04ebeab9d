"""The relaxed plan of a fixed-rope crane, which no exact inverse moves from rest to rest.

`sv.relaxed` against the same problem written by hand for CasADi and IPOPT: Radau collocation with five nodes on 24
intervals, one input for each node, the weight at once, and no refinement or verification.
"""

import casadi as ca
import numpy as np
from harness import Row

import servoctl as sv

CART, LOAD, L, G, T, WAY, BETA = 10.0, 100.0, 4.0, 9.81, 6.0, 5.0, 1e-8  # kg, kg, m, m/s^2, s, m, m^2/N^2
LARGEST = 2.38e-4  # m, by an independent relaxation
INTERVALS, NODES = 24, 5


def plan():
    """The largest error of the load [m], by the toolkit."""
    q = sv.coordinates("x theta")
    x, theta = q
    load = ca.vertcat(x + L * ca.sin(theta), -L * ca.cos(theta))
    S = sv.particle(q, CART, x) + sv.particle(q, LOAD, load)
    plant = sv.plant(sv.Mechanism(q, gibbs=S, potential=LOAD * G * load[1], actuators={"cart": x}))
    r = q.references(X=sv.paths.rest_to_rest(0.0, WAY, T))
    program = sv.Program({"X": load[0] - r.X})
    return lambda: float(np.abs(sv.relaxed(plant, program, (0.0, T), weight=BETA).residual["X"]).max())


def by_hand():
    """The same at the nodes, by hand."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u")
    s, c = ca.sin(x[1]), ca.cos(x[1])
    push = (u + LOAD * s * (L * x[3] ** 2 + G * c)) / (CART + LOAD * s**2)
    rates = ca.Function("rates", [x, u], [ca.vertcat(x[2], x[3], push, -(push * c + G * s) / L)])
    nodes = np.append(0.0, ca.collocation_points(NODES, "radau"))
    slopes, _, weights = (np.array(part) for part in ca.collocation_coeff(list(nodes[1:])))
    h, count = T / INTERVALS, INTERVALS * NODES
    t = (h * (np.arange(INTERVALS)[:, None] + nodes[1:])).ravel()
    r = t / T
    path = WAY * r**5 * (126 - 420 * r + 540 * r**2 - 315 * r**3 + 70 * r**4)

    def call():
        states, inputs = ca.MX.sym("x", 4, count + 1), ca.MX.sym("u", 1, count)
        motion = h * rates.map(count)(states[:, 1:], inputs)
        rows = []
        for k in range(INTERVALS):
            inside = states[:, k * NODES : (k + 1) * NODES + 1]
            rows.append(ca.vec(inside @ slopes - motion[:, k * NODES : (k + 1) * NODES]))
        error = states[0, 1:] + L * ca.sin(states[1, 1:]) - path[None]
        cost = h * ca.dot(error**2 / BETA + inputs**2, ca.repmat(weights.reshape(1, -1), 1, INTERVALS))
        ends = ca.vertcat(states[:, 0], states[:, -1] - ca.DM([WAY, 0.0, 0.0, 0.0]))
        problem = {"x": ca.vertcat(ca.vec(states), ca.vec(inputs)), "f": cost / count, "g": ca.vertcat(*rows, ends)}
        options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
        solver = ca.nlpsol("by_hand", "ipopt", problem, options)
        guess = np.zeros((4, count + 1))
        guess[0, 1:] = path
        found = solver(x0=np.concatenate([guess.ravel(order="F"), np.zeros(count)]), lbg=0.0, ubg=0.0)
        call.iterations = solver.stats()["iter_count"]
        w = np.array(found["x"]).ravel()[: 4 * (count + 1)].reshape(4, -1, order="F")
        return float(np.abs(w[0, 1:] + L * np.sin(w[1, 1:]) - path).max())

    return call


def row():
    hand = "CasADi and IPOPT by hand"
    title = "Relaxed plan of a fixed-rope crane, largest error within 2 %"
    return Row(title, plan(), {hand: by_hand()}, lambda largest: abs(largest / LARGEST - 1), 0.02)


ROWS = {"relaxed": row}
