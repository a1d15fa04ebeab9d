"""Names of signals in python-control, and the loop of a plant and a law by them."""

from servoctl.checks import text, texts
from servoctl.errors import SpecificationError

SYSTEMS = "sv.derive (run.model of a plan), sv.plant, a law such as sv.lqr, or sv.close"


def output_names(plant):
    """Output names of a plant: its states, and the outputs of the mechanism."""
    return [*signal_names(plant.state_names, plant.inputs), *plant.mechanism.outputs]


def signal_names(names, inputs):
    """Signal names of states: "lagged a" for the state of an actuator a, whose input is "a"."""
    return [f"lagged {name}" if name in inputs else name for name in names]


def disturbed_names(plant, disturbed):
    """Names of disturbed generalised forces and parameters, from one name or several, and their indices in p."""
    names = texts(disturbed, "The names of what is disturbed")
    return names, [plant.disturbed(name) for name in names]


def system_name(name, default):
    """A name that python-control accepts for a system, or the default for None."""
    if name is None:
        return default
    if not text("name", name).strip() or "." in name:
        raise SpecificationError(f"name={name!r} was given.", "A system's name is a text without dots.", name=name)
    return name


def disturbable_of(closed):
    """Names of generalised forces, and of parameters that are disturbed in a loop."""
    return tuple(dict.fromkeys((*closed.plant.disturbable, *closed.conditions.disturbance)))


def connected(system, law_system, closed, name):
    """The loop of a plant's system and a law's, nonlinear or linear."""
    import control

    plant, law = closed.plant, closed.law
    measured = signal_names(law.measures, law.inputs)
    wires = [[f"plant.{a}", f"law.{a}"] for a in law.inputs] + [[f"law.{y}", f"plant.{y}"] for y in measured]
    disturbances, outputs = [f"disturbance {name}" for name in disturbable_of(closed)], output_names(plant)
    return control.interconnect(
        [system, law_system],
        wires,
        name=name,
        inplist=[*(f"plant.{d}" for d in disturbances), *(f"law.{y}" for y in measured)],
        inputs=[*disturbances, *(f"noise {y}" for y in measured)],
        outlist=[*(f"plant.{y}" for y in outputs), *(f"law.{a}" for a in law.inputs)],
        outputs=[*outputs, *(f"command {a}" for a in law.inputs)],
    )
