"""Figures of runs, loops and studies."""
