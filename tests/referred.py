"""A crane (flat) and a cart with a pendulum (integrated) along references, or along a formula of time, equal between breaks."""

from math import comb

import casadi as ca

import servoctl as sv

CRANE = {"start": (0.0, 4.0), "end": (5.0, 2.0), "duration": 6.0, "smoothness": 4}
CART = {"start": 0.0, "end": 1.0, "duration": 1.0, "smoothness": 4}


def polynomial(t, start, end, duration, smoothness=4):
    """The values (n, 1) of `rest_to_rest` for 0 <= t <= duration: a polynomial of t, which goes on outside."""
    s, start, end = t / duration, ca.vertcat(start), ca.vertcat(end)
    step = 0.5 + (s - 0.5) * sum(comb(2 * j, j) * (s * (1 - s)) ** j for j in range(smoothness + 1))
    return start + (end - start) * step


def crane_parts():
    """The crane without a program, and where its load is."""
    q = sv.coordinates("x l theta")
    x, l, theta = q
    p = sv.parameters(m_t=10.0, m_l=100.0, g=9.81)
    X, Z = x + l * ca.sin(theta), -l * ca.cos(theta)
    masses = sv.particle(q, p.m_t, [x, 0]) + sv.particle(q, p.m_l, [X, Z])
    return sv.Mechanism(q, masses, p.m_l * p.g * Z, {"trolley": x, "hoist": l}, p), X, Z


def crane(formula=False, **changed):
    mechanism, X, Z = crane_parts()
    if formula:
        to = polynomial(mechanism.q.t, **CRANE | changed)
    else:
        path = sv.paths.rest_to_rest(**CRANE | changed)
        to = [*mechanism.q.references(X=path[0], Z=path[1])]
    return sv.derive(mechanism, sv.Program({"X": X - to[0], "Z": Z + to[1]}, by="actuators"))


def cart(formula=False, up=False, **changed):
    q = sv.coordinates("x theta")
    x, theta = q
    p = sv.parameters(M=1.0, m=0.1, L=0.5, g=9.81)
    tip = [x + p.L * ca.sin(theta), (1 if up else -1) * p.L * ca.cos(theta)]
    masses = sv.particle(q, p.M, [x, 0]) + sv.particle(q, p.m, tip)
    mechanism = sv.Mechanism(q, masses, p.m * p.g * tip[1], {"force": x}, p)
    spec = CART | changed
    to = polynomial(q.t, **spec) if formula else q.references(r=sv.paths.rest_to_rest(**spec)).r
    return sv.derive(mechanism, sv.Program({"X": x - to}, by="actuators"))
