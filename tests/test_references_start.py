"""A start along references is that along a formula of time: the rest nearest to the guess."""

import numpy as np
import pytest
import referred


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (referred.cart, {"guess": {"theta": 0.3}}),
        (referred.cart, {"theta": 0.1}),
        (referred.cart, {"t": 0.5, "guess": {"theta": 0.3}}),
        (referred.crane, {}),
        (referred.crane, {"t": 0.5, "guess": {"l": 4.0}}),
    ],
)
def test_the_start_is_that_along_a_formula(make, options):
    old, new = (make(formula=formula).start(**options) for formula in (True, False))
    assert np.abs(new.values - old.values).max() < 1e-14 and new.held == old.held and new.free == old.free
    assert len(new.branches) == len(old.branches)


def test_where_a_path_begins_at_rest_a_pendulum_hangs():
    assert np.array_equal(referred.cart().start(guess={"theta": 0.3}).values, np.zeros(4))
