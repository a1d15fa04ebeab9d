"""The same machine in other coordinates: other origins, zeros of angles, units, axes and names."""

from functools import partial

import casadi as ca

import servoctl as sv


def moved(mechanism, program, shifts=None, scales=None, reverse=False):
    """A mechanism and a program in coordinates x of which the old ones are scale x + shift, by name; reversed names.

    Generalised forces of x are those of the old coordinates times their scales, so that actuators keep their units.
    Quasi-velocities stay what they are, with the old names.
    """
    q, count = mechanism.q, mechanism.q.n
    names = [f"{'zyxwvutsrq'[i] if reverse else 'n'}{name}" for i, name in enumerate(q.names)]
    order = sorted(range(q.nq), key=lambda i: names[i]) if reverse else list(range(q.nq))
    place = [order.index(i) for i in range(q.nq)]
    s, c = (ca.SX([(some or {}).get(name, float(k)) for name in q.names]) for some, k in ((scales, 1), (shifts, 0)))
    bare = sv.coordinates(" ".join(names[i] for i in order))
    bare.family = q.family  # the same references

    def there(expression, new=bare, jets=0):
        old = ca.vertcat(q.t, *(q.jet(k) for k in range(jets + 1)))
        known = [s * new.jet(k)[place] if q.plain else new.jet(k) for k in range(1, jets + 1)]
        return ca.substitute(ca.SX(expression), old, ca.vertcat(new.t, s * new.jet(0)[place] + c, *known))

    new, factors, rows = bare, s, order
    if not q.plain:
        V, h = ((there(part) / ca.repmat(s, 1, part.shape[1]))[order, :] for part in (q.V, q.h))
        invariants = {name: there(e) for name, e in q.invariants.items()}
        new = bare.with_quasi_velocities(" ".join(q.velocity_names), V, h, invariants)
        factors, rows = ca.SX.ones(count), list(range(count))
    new.identity = {names[q.names.index(name)]: value for name, value in q.identity.items()}
    of = partial(there, new=new, jets=4)
    actuators = {name: (factors * of(mechanism.E[:, j]))[rows] for j, name in enumerate(mechanism.actuators)}
    others = {"constraints": mechanism.constraints, "outputs": mechanism.outputs}
    others = {what: {name: of(e) for name, e in some.items()} for what, some in others.items()}
    balance = (factors * of(mechanism.balance))[rows]
    machine = sv.Mechanism(new, balance=balance, actuators=actuators, parameters=mechanism.parameters, **others)
    chosen = ({name: of(e) if isinstance(e, ca.SX) else e for name, e in some.items()}
              for some in (program.residuals, program.weights, program.toward))  # fmt: skip
    velocities = {} if q.plain else {name: name for name in q.velocity_names}
    return machine, program.again(*chosen), dict(zip(q.names, names, strict=True)) | velocities


def values(known, names, shifts, scales):
    """Values of old coordinates and derivatives by name as those of the new ones."""
    found = {}
    for name, value in (known or {}).items():
        prefix = next((p for p in ("", "d", "d2", "d3") if name.startswith(p) and name[len(p) :] in names), None)
        assert prefix is not None, name
        base = name[len(prefix) :]
        found[prefix + names[base]] = (value - (shifts.get(base, 0.0) if not prefix else 0.0)) / scales.get(base, 1.0)
    return found
