"""Nonlinear programs by IPOPT: settings that all share, and what it says where it finds no solution."""

import casadi as ca
import numpy as np

PIVOTS = 0.1  # threshold of MUMPS: with smaller ones rounding hides the inertia of stiff machines
LONGEST = 120.0  # of a solution [s]
IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    "acceptable_tol": 1e-6,  # rounding of φ²/β for small β
    "acceptable_iter": 2,
    "acceptable_constr_viol_tol": 1e-9,
    "max_iter": 200,
    "bound_relax_factor": 0.0,
    "nlp_scaling_method": "none",
    "mu_strategy": "adaptive",
    "mumps_pivtol": PIVOTS,
    "max_wall_time": LONGEST,
}
WARM = {
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
    "warm_start_slack_bound_push": 1e-9,
    "warm_start_bound_frac": 1e-9,
    "warm_start_slack_bound_frac": 1e-9,
    "mu_init": 1e-6,
    "mu_strategy": "monotone",
}
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
STATUS = {
    "Infeasible_Problem_Detected": "finds no motion",
    "Maximum_Iterations_Exceeded": "does not converge in 200 iterations",
    "Maximum_WallTime_Exceeded": f"does not converge in {LONGEST:g} s",
    "Restoration_Failed": "finds no way back to the equations of motion",
}


class NonlinearProgram:
    """min f(x, p) subject to bounds of x and of g(x, p), `problem` by CasADi's names; solved from an approximation."""

    def __init__(self, problem):
        self._problem, self._solvers = problem, {}

    def solve(self, warm=False, **given):
        """CasADi's result as arrays by name, and IPOPT's statistics.

        `given` are x0, p, lbx, ubx, lbg and ubg; with `warm` the multipliers lam_x0 and lam_g0 of a nearby solution.
        """
        if warm not in self._solvers:
            quiet = {"print_time": False, "show_eval_warnings": False, "calc_lam_p": False}
            options = quiet | {"ipopt": IPOPT | (WARM if warm else {})}
            self._solvers[warm] = ca.nlpsol("nonlinear_program", "ipopt", self._problem, options)
        result = self._solvers[warm](**given)
        return {name: np.array(value).ravel() for name, value in result.items()}, self._solvers[warm].stats()


def words(stats):
    """How an iteration ended without a solution; "" if it has one."""
    status = stats["return_status"]
    return "" if status in SOLVED else STATUS.get(status, status)
