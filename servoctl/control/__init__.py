"""Laws, the sampled closed loop, limits."""
