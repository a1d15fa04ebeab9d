"""Comparisons with peers (`python benchmarks/run.py`) and with the literature (`benchmarks.literature`)."""
