"""What the literature does instead, measured on servoctl's models; run from the root of a checkout."""

from benchmarks.literature.formulations import FormulationCost, formulation_cost
from benchmarks.literature.guided_arm import guided_arm
from benchmarks.literature.servo_dae import DaeComparison, dae_comparison

__all__ = ["DaeComparison", "FormulationCost", "dae_comparison", "formulation_cost", "guided_arm"]
