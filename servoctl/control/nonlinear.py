"""Nonlinear programs by IPOPT: settings that all share, and what it says where it finds no solution."""

import casadi as ca

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
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
STATUS = {
    "Infeasible_Problem_Detected": "finds no motion",
    "Maximum_Iterations_Exceeded": "does not converge in 200 iterations",
    "Maximum_WallTime_Exceeded": f"does not converge in {LONGEST:g} s",
    "Restoration_Failed": "finds no way back to the equations of motion",
}


def solver(problem):
    """CasADi's solver of min f(x, p) subject to bounds of x and of g(x, p), from its expressions by these names."""
    quiet = {"print_time": False, "show_eval_warnings": False, "calc_lam_p": False}
    return ca.nlpsol("nonlinear_program", "ipopt", problem, quiet | {"ipopt": IPOPT})


def words(stats):
    """How an iteration ended without a solution; "" if it has one."""
    status = stats["return_status"]
    return "" if status in SOLVED else STATUS.get(status, status)
