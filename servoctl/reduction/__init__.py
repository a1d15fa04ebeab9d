"""From a specification to the rows of its motion: eq. (3.18), hidden constraints, ranks, structure."""
