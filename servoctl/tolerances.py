"""Numbers that decide what is zero, used by several packages; other numbers are at the top of the files that use them.

docs/numbers.md lists them with all others, and the tests that pin them.
"""

import numpy as np

EXTENDED = np.finfo(np.longdouble).eps < 1e-18  # whether long doubles hold more digits than doubles
ENTRY = 1e-12  # an entry below this fraction of the size of its terms is a rounding error in double precision
NOISE = 1e-14 if EXTENDED else 1e-13  # an equilibrated pivot below this is the rounding of constants folded in double
RESOLVED = 1e-10  # division by an equilibrated pivot above this leaves six digits of double precision
DEPENDENT = 1e-11  # largest residual of an equilibrated row that is a combination of other rows
CUTOFF = 1e-11  # singular values below this fraction of the largest do not count in least squares
REFINEMENTS = 3  # steps in double precision with residuals in extended precision; each gains at least ten digits
LAST_EXPONENT = 138.15510557964274  # ln 1e60, beyond which bounded functions of exponentials have their limits
TINY = 1e-300  # keeps denominators from zero, and decides nothing
