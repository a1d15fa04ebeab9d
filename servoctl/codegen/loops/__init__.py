"""The loops over an emitted function, as C text: a grid, Runge-Kutta steps, Newton's iteration, Taylor steps.

NAME stands for the function's name, N_X, N_P and N_Y for the numbers of its states, parameters and outputs; the
function is ``NAME(t, x, p, y)``, and NAME_PROJECT(t, x, p) restores invariants where there is something to restore
them.
"""

from servoctl.codegen.loops.circular import circular
from servoctl.codegen.loops.grid import GRID, PROJECTION
from servoctl.codegen.loops.lanes import lanes
from servoctl.codegen.loops.newton import NEWTON
from servoctl.codegen.loops.rk import RK
from servoctl.codegen.loops.taylor import TAYLOR

__all__ = ["BISECTIONS", "GRID", "LOOPS", "NEAR", "PROJECTION", "QUADRATIC", "ROUNDING", "circular", "lanes"]

BISECTIONS = 20  # halvings of one time step in newton: a millionth of it is a lost solution, not a long step
ROUNDING = 2.0**-52  # a Newton correction this small relative to 1 + |x| cannot be reduced by another
NEAR = 1e-3  # relative to 1 + |x|: a prediction for several points at once that is worse is not trusted
QUADRATIC = 1e-8  # a Newton correction this small leaves an error of the order of rounding

LOOPS = {"rk": RK, "newton": NEWTON, "taylor": TAYLOR}
