"""What was once answered absurdly and in silence: one row a fault, with the tests that hold its right answer."""

from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
ORIGIN, NAMES, SETS, TWICE, PASSED, DOOR, START = (
    f"test_{name}.py"
    for name in ("no_special_origin", "one_name", "exceptional_sets", "described_twice", "what_passed_means", "at_the_door", "start")
)
ROWS = {
    "a guess 5 cm off a damped crane: 39 m/s and 308,000 N": (ORIGIN, "a_damped_crane_starts_at_rest"),
    "a rope of negative length, by where its rail lies": (ORIGIN, "a_rope_keeps_the_sign_of_its_guess"),
    "a transient that a held value causes": (PASSED, "a_first_transient_is_named_with_the_start_that_has_none"),
    "a plan that depends on the origin of its coordinates": (ORIGIN, "the_crab_crane_needs_the_same_forces_everywhere"),
    "a plan that depends on the zero of an angle": (ORIGIN, "machines_need_the_same_forces_everywhere"),
    "the same scene in other units, axes and names": (ORIGIN, "scenes_need_the_same_forces_in_other_coordinates"),
    "a nearest value that is refused in its turn": (START, "held_values_that_contradict_each_other_are_all_named"),
    "held outputs taken for guesses of states": (START, "an_output_that_is_held_at_a_standstill"),
    "a guess that no state is near": (START, "a_guess_that_no_state_is_near_is_printed_with_its_distance"),
    "an angle in degrees": (START, "an_angle_that_looks_like_degrees_is_printed_in_radians"),
    "two roots, one of them nearer to the guess": (ORIGIN, "a_rope_keeps_the_sign_of_its_guess"),
    "an orientation half a turn off with no residual": (SETS, "a_start_is_at_the_wished_orientation"),
    "a held base without a plant": (SETS, "a_held_base_has_a_plant"),
    "an arm on a ship at 7e23 rad/s": (SETS, "an_arm_on_a_ship"),
    "rows left out as dependent that do not hold": (SETS, "rows_left_out_hold_where_a_start_is_found"),
    "a quadrotor that is not flat in its quaternion": (SETS, "a_quadrotor_from_hover_is_flat_with_any_velocities"),
    "a quaternion of zeros": (SETS, "a_zero_quaternion_is_refused"),
    "inertia in a force, which the plant does not see": (TWICE, "inertia_in_a_force_reaches_plan_plant_and_loop"),
    "a file's rotor": (TWICE, "rotors_of_a_follower_and_of_two_joints"),
    "gravity counted twice": (TWICE, "a_balance_with_gravity_or_damping_is_not_given_them_again"),
    "a kinetic energy of another machine": (TWICE, "a_kinetic_energy_beside_a_balance_has_its_inertia"),
    "a mass given twice": (TWICE, "inertia_given_twice_is_refused"),
    "rates that no rotation has": (TWICE, "rates_are_those_of_a_rotation_along_the_bodys_axes"),
    "an effort of -1 or 0": (TWICE, "limits_that_limit_nothing_are_named"),
    "a planar linkage of five digits": (TWICE, "angles_of_five_digits_make_a_planar_linkage"),
    "a residual in the place of a coordinate: runs": (NAMES, "runs_read_the_closed_forms_by_each_name"),
    "events": (NAMES, "events_fire_where_run_of_the_same_name_crosses"),
    "bounds": (NAMES, "bounds_hold_for_the_signal_of_the_same_name"),
    "integrals of a law": (NAMES, "integrals_hold_the_signal_of_the_same_name"),
    "actuators that bear a coordinate's name": (NAMES, "actuators_go_by_either_name_where_nothing_else_is_meant"),
    "q and q.d(1) that index and unpack": (NAMES, "coordinates_and_their_rates_are_columns_that_unpack"),
    "forces of many weights": (PASSED, "a_force_above_ten_times_the_weights"),
    "limits of a robot's file": (PASSED, "limits_of_a_robots_file"),
    "strokes of a mechanism": (PASSED, "limits_that_a_mechanism_declares"),
    "internal dynamics that grow": (PASSED, "growth_of_the_internal_dynamics"),
    "peaks between samples": (PASSED, "steps_that_outnumber_samples"),
    "a loop too slow for its path": (PASSED, "a_loop_that_is_too_slow_for_its_path"),
    "a loop too slow for its machine": (PASSED, "a_loop_with_few_samples_in_the_fastest_time_constant"),
    "the command's plan of a program that is unstable": (PASSED, "the_command_takes_the_plan_that_the_inverse_takes"),
    "the command's rate": (PASSED, "the_rate_of_the_command_comes_from_the_plan"),
    "a projection that leaves the start off": (DOOR, "projection_begins_with_the_start"),
    "a push between the steps of a loop": (DOOR, "a_push_has_its_impulse_wherever_it_lies"),
    "the constant of an integral in the splitting": (DOOR, "a_program_of_a_speed_has_the_inverse_of_its_place"),
    "a maximum called a minimum": (DOOR, "a_design_leaves_a_stationary_point_for_less_cost"),
    "complex numbers": (DOOR, "a_complex_number_is_refused"),
    "forces without values from exported C": (DOOR, "exported_c_answers_numbers_or_its_error"),
}  # fmt: skip


@pytest.mark.parametrize("fault", ROWS)
def test_each_fault_has_its_test(fault):
    module, name = ROWS[fault]
    assert f"\ndef test_{name}(" in (FOLDER / module).read_text(encoding="utf-8")
