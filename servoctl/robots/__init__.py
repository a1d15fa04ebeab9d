"""Robots from their files: a tree of bodies becomes coordinates, a balance and frames."""
