"""Studies: the measured trade of speed and accuracy, stability, sweeps; tables of numbers on models and runs."""
