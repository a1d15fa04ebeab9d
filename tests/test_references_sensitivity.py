"""Derivatives of motions along references by parameters: references do not depend on these."""

import numpy as np
import pytest
import referred

import servoctl as sv


@pytest.mark.parametrize(
    ("make", "span", "values"),
    [(referred.crane, (0.0, 6.0), {}), (referred.cart, (0.0, 1.0), {"theta": 0.1, "dtheta": 0.0})],
)
def test_sensitivities_are_those_along_a_formula(make, span, values):
    found = []
    for formula in (True, False):
        model = make(formula=formula)
        start = model.start(guess={"l": 4.0} if "l" in model.state_names else None, **values)
        run = sv.simulate(model, start, span, "algebraic" if model.flat else "DOP853", t_eval=np.linspace(*span, 41))
        found.append(sv.sensitivity(run, to=[*model.numbers, *values]))
    wanted, new = found
    for pair in wanted.names:
        # the second case is integrated to 1e-9, with steps of its own
        assert np.abs(new[pair] - wanted[pair]).max() <= (1e-7 if values else 1e-11) * max(
            np.abs(wanted[pair]).max(), 1e-9
        )
    assert new.independent == wanted.independent
