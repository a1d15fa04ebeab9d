"""Derivatives of motions by parameters and initial values, and parameters from measurements."""
