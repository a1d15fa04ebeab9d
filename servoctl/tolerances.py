"""Numbers that decide what is zero, used in more than one room; those of one room stand at the top of its files.

docs/numbers.md says what each decides, and what goes wrong with ten times more or less.
"""

import numpy as np

EXTENDED = np.finfo(np.longdouble).eps < 1e-18  # whether long doubles hold more digits than doubles
ENTRY = 1e-12  # an entry below this fraction of the size of its terms is zero: their rounding in double precision
NOISE = 3e-17 if EXTENDED else 1e-13  # an equilibrated pivot below this is zero: rounding of extended precision
RESOLVED = 1e-10  # an equilibrated pivot above this can be divided by in double precision, six digits left
DEPENDENT = 1e-11  # a row of which no more is left by a combination of others depends on them, all equilibrated
CUTOFF = 1e-11  # singular values below this fraction of the largest do not count in least squares
REFINEMENTS = 3  # least squares in double precision, residuals in extended: each gains ten digits or more
TINY = 1e-300  # keeps a denominator from zero, and decides nothing
