"""A function of (t, x, p) becomes code."""
