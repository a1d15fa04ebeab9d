"""A mechanism with its program in other units, and its initial values: the same motion by other numbers."""

import re

import casadi as ca

import servoctl as sv

_NAME = re.compile(r"d(\d*)(.+)")


def powers_of_length(q, units):
    """The power of length of each coordinate, and of each component of γ'."""
    of_q = {name: int(units[name] == "m") for name in q.names}
    return of_q, dict(of_q) if q.plain else {name: int(units[name] == "m/s") for name in q.velocity_names}


def in_units(mechanism, program, units, length=1.0, mass=1.0, time=1.0):
    """The mechanism and the program with `length` units per metre, `mass` per kilogram, `time` per second.

    Coordinates in metres are those of `units`; the expressions are those of the designer in other symbols.
    """
    old = mechanism.q
    of_q, of_w = ({name: length**k for name, k in each.items()} for each in powers_of_length(old, units))
    new = sv.coordinates(" ".join(old.names))
    inner = [new.t / time, *(s / of_q[name] for name, s in zip(old.names, new, strict=True))]
    outer = [old.t, *old]
    if not old.plain:
        V = ca.diag(list(of_q.values())) @ old.V @ ca.diag([1 / s for s in of_w.values()])
        V, h = ca.substitute([V, ca.diag(list(of_q.values())) @ old.h / time], [ca.vertcat(*outer)], [ca.vertcat(*inner)])
        new = new.with_quasi_velocities(" ".join(old.velocity_names), V, h)
    steps = 0 if old.plain else 1  # a rate w is no derivative of a coordinate: its level 1 has its own unit
    for k in range(1, 8):
        outer += old.gamma(k)
        scales = (s * time ** -(k - steps) for s in of_w.values())
        inner += [s / scale * (1.0 if old.plain else time**0) for s, scale in zip(new.gamma(k), scales, strict=True)]
    if not old.plain:  # w in length per time
        inner = inner[: 1 + old.nq] + [s * time for s in inner[1 + old.nq :]]
    references = new.references(**{name: path.at_rate(1 / time, about=0.0) for name, path in old.family.paths.items()})
    for k in range(12):
        outer += [old.family.jet(name, k) for name in references.names]
        inner += [jet * time**k for jet in references.d(k)]

    def change(expression):
        return ca.substitute(ca.SX(expression), ca.vertcat(*outer), ca.vertcat(*inner))

    energy = mass * length**2 / time**2
    forces = ca.diag([energy / s for s in of_w.values()])
    columns = ca.horzsplit(forces @ change(mechanism.E)) if mechanism.actuators else []
    changed = sv.Mechanism(
        new,
        balance=forces @ change(mechanism.balance),
        actuators=dict(zip(mechanism.actuators, (c.elements() for c in columns), strict=True)),
        constraints={name: length * change(e) for name, e in mechanism.constraints.items()},
        parameters=mechanism.parameters,
    )
    residuals = {name: length * change(e) for name, e in program.residuals.items()}
    weights = program.weights if program.by == "actuators" else None
    return changed, sv.Program(residuals, by=program.by, weights=weights)


def scale(name, q, units, length=1.0, time=1.0):
    """The factor of a state in these units."""
    of_q, of_w = powers_of_length(q, units)
    if name in of_q:
        return length ** of_q[name]
    if name in of_w:
        return length ** of_w[name] / time
    order, base = _NAME.fullmatch(name).groups()
    known, first = (of_w, 1) if base in of_w and not q.plain else (of_q, 0)
    return length ** known[base] / time ** (int(order or 1) + first)
