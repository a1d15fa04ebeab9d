"""python-control and MuJoCo.

python-control: models, plants, laws and closed loops as its nonlinear and linear systems, by name.

Names of signals and states are those of servoctl. A lagged actuator is a state beside the input of the same name: as
a signal it is "lagged NAME". Disturbances are the inputs "disturbance NAME", by generalised force.
"""

from servoctl.interop.linear import along, linearise, loop_gain
from servoctl.interop.mujoco_plant import mujoco
from servoctl.interop.nonlinear import nlsys, start

__all__ = ["along", "linearise", "loop_gain", "mujoco", "nlsys", "start"]
