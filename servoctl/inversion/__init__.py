"""Which inverse of a program exists, and the plan that it gives."""
