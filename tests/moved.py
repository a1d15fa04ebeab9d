"""The same machine in other coordinates: other origins, zeros of angles, units, axes and names."""

import casadi as ca

import servoctl as sv


def moved(mechanism, program, shifts=None, scales=None, reverse=False):
    """A mechanism and a program in coordinates x of which the old ones are scale x + shift, by name; reversed names.

    Generalised forces of x are those of the old coordinates times their scales, so that actuators keep their units.
    """
    q = mechanism.q
    assert q.plain
    names = [f"{'zyxwvutsrq'[i] if reverse else 'n'}{name}" for i, name in enumerate(q.names)]
    order = sorted(range(q.n), key=lambda i: names[i]) if reverse else range(q.n)
    new = sv.coordinates(" ".join(names[i] for i in order))
    place = [list(order).index(i) for i in range(q.n)]
    s = ca.SX([(scales or {}).get(name, 1.0) for name in q.names])
    old, known = [q.t], [new.t]
    for k in range(5):
        jet = new.jet(k)[place]
        old.append(q.jet(k))
        known.append(s * jet + (ca.SX([(shifts or {}).get(name, 0.0) for name in q.names]) if k == 0 else 0))
    symbols = ca.vertcat(*old), ca.vertcat(*known)

    def there(expression):
        return ca.substitute(ca.SX(expression), *symbols)

    balance = (s * there(mechanism.balance))[list(order)]
    actuators = {name: (s * there(mechanism.E[:, j]))[list(order)] for j, name in enumerate(mechanism.actuators)}
    others = {"constraints": mechanism.constraints, "outputs": mechanism.outputs}
    others = {what: {name: there(e) for name, e in some.items()} for what, some in others.items()}
    machine = sv.Mechanism(new, balance=balance, actuators=actuators, parameters=mechanism.parameters, **others)
    residuals = {name: there(e) for name, e in program.residuals.items()}
    return machine, sv.Program(residuals, by=program.by), dict(zip(q.names, names, strict=True))


def values(known, names, shifts, scales):
    """Values of old coordinates and derivatives by name as those of the new ones."""
    found = {}
    for name, value in (known or {}).items():
        prefix = next((p for p in ("", "d", "d2", "d3") if name.startswith(p) and name[len(p) :] in names), None)
        assert prefix is not None, name
        base = name[len(prefix) :]
        found[prefix + names[base]] = (value - (shifts.get(base, 0.0) if not prefix else 0.0)) / scales.get(base, 1.0)
    return found
