"""Motions of a model: integrators, drift, runs and their proofs."""
