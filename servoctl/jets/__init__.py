"""Taylor arithmetic: the series of an expression along a motion."""
