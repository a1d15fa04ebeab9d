"""Expressions become functions on numbers: emitted as C, compiled, cached; the seam between CasADi and NumPy."""
