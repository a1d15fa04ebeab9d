"""The table of scenes: what each is, what it teaches, where it comes from, and a number that it must give."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module

BUILDERS = {  # name of a function: its module in this package, imported when it is used
    "acrobot": "pendulums",
    "appell_hamel": "rolling",
    "ball_and_beam": "pendulums",
    "ball_on_turntable": "contacts",
    "beam_crane": "gantries",
    "bicycle": "bicycles",
    "cable_robot": "chains",
    "cars": "springs",
    "cart_pole": "pendulums",
    "clothoid_arm": "high_orders",
    "constant_jerk": "jerk",
    "constant_speed": "speed",
    "crane_3d": "cranes",
    "double_pendulum": "hanging",
    "elastic_link": "flexible",
    "fixed_rope_crane": "gantries",
    "flexible_joint": "flexible",
    "four_bar": "chains",
    "furuta_pendulum": "pendulums",
    "hopper": "flight",
    "jerkless_trolley": "jerk",
    "mass_on_car": "guides",
    "overhead_crane": "cranes",
    "passive_arm": "two_links",
    "pendubot": "two_links",
    "planar_arm": "links",
    "reaction_wheels": "attitude",
    "rolling_disc": "contacts",
    "rotary_crane": "gantries",
    "six_axis_arm": "six_axes",
    "slung_load": "slung",
    "slung_load_3d": "slung",
    "spatial_arm": "links",
    "spiral": "spirals",
    "steady_satellite": "high_orders",
    "trailers": "hitched",
    "tumbling_satellite": "attitude",
    "two_link_arm": "two_links",
    "vtol": "aircraft",
    "wheeled_robot": "wheels",
    "winch_crane": "cranes",
}


def builder(name):
    """The function of a name, from its module."""
    return getattr(import_module(f"servoctl.gallery.{BUILDERS[name]}"), name)


def _built(name, *arguments, **options):
    return builder(name)(*arguments, **options)


@dataclass(frozen=True)
class Scene:
    """A mechanism with a program, initial values and a time span.

    Parameters
    ----------
    build : callable
        Returns (Mechanism, Program).
    description : str
        One sentence.
    group : str
        The subject that it belongs to, in two or three words.
    teaches : str
        What it teaches, one sentence.
    source : str
        The publication, or the closed form, that it comes from.
    number : str
        One sentence with a number that the source or a closed form gives.
    start : dict of str to float
        Free initial values by name, SI.
    guess : dict of str to float
        Guesses of the other initial values by name, SI.
    t_span : (2,) tuple of float
        [s]
    units : dict of str to str
        Units by name, beside those of the mechanism or instead of them.
    """

    build: Callable
    description: str
    group: str = ""
    teaches: str = ""
    source: str = ""
    number: str = ""
    start: dict = field(default_factory=dict)
    guess: dict = field(default_factory=dict)
    t_span: tuple = (0.0, 1.0)
    units: dict = field(default_factory=dict)

    def __post_init__(self):
        if self.units:
            object.__setattr__(self, "build", partial(_in_units, self.build, self.units))


def _in_units(build, units, *arguments, **options):
    mechanism, program = build(*arguments, **options)
    mechanism.units = mechanism.units | units
    return mechanism, program


FLAT_MACHINES = "flat machines"
MATERIAL_CONSTRAINTS = "material constraints"
INTERNAL_DYNAMICS = "internal dynamics"
ARMS_AND_ROBOTS = "arms and robots"
IDEAL_REACTIONS = "ideal reactions"
HIGHER_ORDERS = "higher orders"
ROLLING_MACHINES = "rolling machines"
SINGULAR_PROGRAMS = "singular programs"

BLAJER = "Blajer and Kołodziejczyk, Nonlinear Dynamics 50 (2007) 781-791"
EMAMI = "Emami, Zohoor and Sohrabpour (docs/paper.md)"
SEIFRIED = "Seifried and Blajer, Mechanical Sciences 4 (2013) 113-129"
SREENATH = "Sreenath, Lee and Kumar, IEEE Conference on Decision and Control (2013) 2269-2274"
FLIESS = "Fliess, Lévine, Martin and Rouchon, International Journal of Control 61 (1995) 1327-1361"

_APPELL_HAMEL = {
    "source": EMAMI,
    "start": {"x": 0.0, "y": 0.0, "phi": 0.0, "theta": 0.0, "dphi": 1.0, "dtheta": 2.0},
    "guess": {"dx": 0.5, "dy": 0.6},
    "t_span": (0.0, 2.0),
}

_PRECESSION = {  # dphi by g tan λ = a Ω (3 s/2 + Ω sin(λ)/4), s = dphi - Ω sin λ
    "x": 0.0,
    "y": 0.0,
    "psi": 0.0,
    "lean": 0.35,
    "phi": 0.0,
    "dpsi": 1.5,
    "dlean": 0.0,
    "dphi": 5.733703050854819,
}

gallery = {
    # --- flat machines
    "overhead-crane": Scene(
        partial(_built, "overhead_crane"),
        "A trolley and a hoist carry a load along a straight path.",
        group=FLAT_MACHINES,
        teaches="A path of the load alone determines trolley, rope and both forces, without integration.",
        source=FLIESS,
        number="The hoist holds at most 1044 N.",
        guess={"l": 4.0},
        t_span=(0.0, 8.0),
    ),
    "winch-crane": Scene(
        partial(_built, "winch_crane"),
        "Blajer's crane: a trolley and a winch carry a load.",
        group=FLAT_MACHINES,
        teaches="A rotating drum instead of a hoist changes the actuation, not the motion of the load.",
        source=BLAJER,
        number="The winch holds at most 102.2 N m.",
        guess={"beta": 40.0},
        t_span=(0.0, 6.0),
    ),
    "crane-3d": Scene(
        partial(_built, "crane_3d"),
        "A bridge, a trolley and a hoist lift a load along a quarter turn.",
        group=FLAT_MACHINES,
        teaches="Three residuals for five coordinates: two hidden constraints, the balances of both angles.",
        source=BLAJER,
        number="The rope's tension is at most 1070 N.",
        guess={"l": 5.0},
        t_span=(0.0, 6.0),
    ),
    "two-cars": Scene(
        partial(_built, "cars"),
        "Two cars joined by a spring: the first follows a path, the second is driven.",
        group=FLAT_MACHINES,
        teaches="A force that acts through a spring needs the path's fourth derivative.",
        source=SEIFRIED,
        number="The force is at most 316.2 N.",
        t_span=(0.0, 2.0),
    ),
    "three-cars": Scene(
        partial(_built, "cars", 3),
        "Three cars joined by springs: the first follows a path, the last is driven; index 7.",
        group=FLAT_MACHINES,
        teaches="Each further spring raises the index by two, and the forces by orders of magnitude.",
        source=f"{SEIFRIED}, by one car more",
        number="The force is at most 11770 N.",
        t_span=(0.0, 2.0),
    ),
    "vtol": Scene(
        partial(_built, "vtol"),
        "The flat point of an aircraft with tilted thrusters follows a path.",
        group=FLAT_MACHINES,
        teaches="The choice of the point decides: this one determines the whole motion.",
        source="Martin, Devasia and Paden, Automatica 32 (1996) 101-107",
        number="The left thruster gives at most 295.5 N.",
        t_span=(0.0, 4.0),
    ),
    "slung-load": Scene(
        partial(_built, "slung_load"),
        "A quadrotor in a vertical plane carries a load on a rope along a path.",
        group=FLAT_MACHINES,
        teaches="Thrust and moment follow from the load's path and its derivatives up to the sixth.",
        source=SREENATH,
        number="The thrust is at most 17.38 N.",
        t_span=(0.0, 5.0),
    ),
    "slung-load-3d": Scene(
        partial(_built, "slung_load_3d"),
        "A quadrotor in space carries a load on a rope up a quarter turn and keeps its heading.",
        group=FLAT_MACHINES,
        teaches="Eight coordinates and four inputs: the load's path and a heading determine all of them.",
        source=SREENATH,
        number="The thrust is at most 15.69 N.",
        t_span=(0.0, 6.0),
    ),
    "flexible-joint": Scene(
        partial(_built, "flexible_joint"),
        "A link turns by 90 degrees, by a motor behind an elastic gear with friction.",
        group=FLAT_MACHINES,
        teaches="Elasticity and smooth friction are compensated exactly by the path's fourth derivative.",
        source="Spong, Journal of Dynamic Systems, Measurement, and Control 109 (1987) 310-319; friction added",
        number="The motor's torque is at most 35.59 N m.",
        t_span=(0.0, 1.5),
    ),
    "rotary-crane": Scene(
        partial(_built, "rotary_crane"),
        "A jib that slews, a trolley and a hoist move a load along a spiral.",
        group=FLAT_MACHINES,
        teaches="Centrifugal and Coriolis forces are in the plan, although nobody wrote them down.",
        source="The closed form, tension m |g - a| of the load's acceleration a",
        number="The rope's tension is at most 1008 N.",
        guess={"r": 3.0, "l": 5.0},
        t_span=(0.0, 8.0),
    ),
    # --- material constraints
    "overhead-crane-redundant": Scene(
        partial(_built, "overhead_crane", coordinates="redundant"),
        "The same crane in redundant coordinates, its rope a material constraint.",
        group=MATERIAL_CONSTRAINTS,
        teaches="Coordinates may be redundant: motion and forces are those of the smallest set.",
        source=FLIESS,
        number="The trolley's force is at most 138 N.",
        guess={"l": 4.0, "Z": 4.0},
        t_span=(0.0, 8.0),
    ),
    "winch-crane-redundant": Scene(
        partial(_built, "winch_crane", "redundant"),
        "The winch crane in redundant coordinates, its rope a material constraint.",
        group=MATERIAL_CONSTRAINTS,
        teaches="The balance is polynomial in redundant coordinates, as in the literature on index reduction.",
        source=BLAJER,
        number="The rope's tension is at most 1018 N.",
        guess={"beta": 40.0, "Z": 4.0},
        t_span=(0.0, 6.0),
    ),
    "crane-3d-redundant": Scene(
        partial(_built, "crane_3d", "redundant"),
        "The three-dimensional crane in redundant coordinates, its rope a material constraint.",
        group=MATERIAL_CONSTRAINTS,
        teaches="Without angles there is no chart to leave: the load may swing in all directions.",
        source=BLAJER,
        number="The hoist holds at most 1074 N.",
        guess={"l": 5.0, "Z": 5.0},
        t_span=(0.0, 6.0),
    ),
    "mass-on-car-absolute": Scene(
        partial(_built, "mass_on_car", coordinates="absolute"),
        "The same mass and car in absolute coordinates, the guide a material constraint.",
        group=MATERIAL_CONSTRAINTS,
        teaches="A material constraint changes neither the internal dynamics nor the force.",
        source=SEIFRIED,
        number="The force is at most 12.31 N.",
        start={"x": 0.5, "dx": 0.0},
        t_span=(0.0, 6.0),
    ),
    "four-bar": Scene(
        partial(_built, "four_bar"),
        "The crank of a four-bar linkage makes a full turn from rest to rest.",
        group=MATERIAL_CONSTRAINTS,
        teaches="The loop is two material constraints; crank angle and branch determine the whole linkage.",
        source="Freudenstein, Transactions of the ASME 77 (1955) 853-861; closed form by the law of cosines",
        number="The rocker swings by 0.8981 rad.",
        guess={"coupler": 1.0, "rocker": 1.7},
        t_span=(0.0, 3.0),
    ),
    "beam-crane": Scene(
        partial(_built, "beam_crane"),
        "Two trolleys and two hoists carry a beam that stays level.",
        group=MATERIAL_CONSTRAINTS,
        teaches="Four actuators, two ropes and five degrees of freedom: still computed at each instant.",
        source="The closed form, ropes parallel to g - a",
        number="The trolleys are at most 0.4023 m beside the ends of the beam.",
        guess={"l1": 4.0, "l2": 4.0, "Z": 4.0},
        t_span=(0.0, 6.0),
    ),
    # --- internal dynamics
    "mass-on-car": Scene(
        partial(_built, "mass_on_car"),
        "A mass on an inclined guide of a driven car follows a path; two internal states.",
        group=INTERNAL_DYNAMICS,
        teaches="The guide's inclination decides the relative degree: 4 or 3 when level, 2 when inclined.",
        source=SEIFRIED,
        number="The internal dynamics decay with 0.5 1/s.",
        start={"s": 0.0, "ds": 0.0},
        t_span=(0.0, 6.0),
    ),
    "passive-arm": Scene(
        partial(_built, "passive_arm"),
        "An arm with an elastic passive joint turns by 90 degrees; two stable internal states.",
        group=INTERNAL_DYNAMICS,
        teaches="A point nearer to the base than the tip makes the internal dynamics stable.",
        source="Seifried, Dynamics of Underactuated Multibody Systems (Springer, 2014)",
        number="The internal dynamics decay with 6 1/s where the arm is straight.",
        start={"q2": 0.0, "dq2": 0.0},
        t_span=(0.0, 3.0),
    ),
    "pendubot": Scene(
        partial(_built, "pendubot"),
        "The shoulder of a two-link arm swings it up by 90 degrees; the elbow is passive.",
        group=INTERNAL_DYNAMICS,
        teaches="What the shoulder leaves free is a pendulum, here about its hanging pose.",
        source="Spong and Block, Proceedings of the IEEE Conference on Decision and Control (1995) 555-557",
        number="A small swing of the second link has the frequency 5.345 rad/s.",
        start={"q2": 0.0, "dq2": 0.0},
        t_span=(0.0, 3.0),
    ),
    "vtol-centre": Scene(
        partial(_built, "vtol", "centre"),
        "Its centre of mass instead: the internal dynamics are unstable.",
        group=INTERNAL_DYNAMICS,
        teaches="A plan by forward integration diverges; the bounded inverse looks ahead.",
        source="Hauser, Sastry and Meyer, Automatica 28 (1992) 665-679",
        number="Errors grow with 15.04 1/s in hover.",
        start={"theta": 0.0, "dtheta": 0.0},
        t_span=(0.0, 1.0),
    ),
    "double-pendulum": Scene(
        partial(_built, "double_pendulum"),
        "A cart with a double pendulum moves from rest to rest.",
        group=INTERNAL_DYNAMICS,
        teaches="What hangs from a programmed body is internal dynamics; without damping it swings on.",
        source="closed form: the small oscillations of two equal pendulums",
        number="The slower mode has 2.68 rad/s.",
        start={"upper": 0.0, "lower": 0.0, "dupper": 0.0, "dlower": 0.0},
        t_span=(0.0, 8.0),
    ),
    "elastic-link": Scene(
        partial(_built, "elastic_link"),
        "The hub of an elastic link turns by 90 degrees; four segments vibrate.",
        group=INTERNAL_DYNAMICS,
        teaches="Eight internal states: the modes of a clamped beam, excited by the turn.",
        source="closed form: the modes of four rods with springs",
        number="The slowest mode has 10.81 rad/s.",
        start={f"{d}bend{i}": 0.0 for d in ("", "d") for i in range(1, 5)},
        t_span=(0.0, 2.0),
    ),
    "cart-pole": Scene(
        partial(_built, "cart_pole"),
        "A cart moves by 1 m and a pole balances on it.",
        group=INTERNAL_DYNAMICS,
        teaches="The pole's balance is unstable, and the bounded plan begins before the cart does.",
        source="The closed form, an inverted pendulum: sqrt(g/l)",
        number="Errors grow with 4.429 1/s.",
        start={"theta": 0.0, "dtheta": 0.0},
        t_span=(0.0, 2.0),
    ),
    "fixed-rope-crane": Scene(
        partial(_built, "fixed_rope_crane"),
        "A trolley moves a tool that is 1 m below its swinging load.",
        group=INTERNAL_DYNAMICS,
        teaches="A point below the load makes a stable pendulum an unstable inverse.",
        source="The closed form, poles ±sqrt(g/(d - l))",
        number="Errors grow with 3.132 1/s.",
        start={"theta": 0.0, "dtheta": 0.0},
        t_span=(0.0, 4.0),
    ),
    "furuta-pendulum": Scene(
        partial(_built, "furuta_pendulum"),
        "A driven arm turns by 90 degrees with a pendulum at its end.",
        group=INTERNAL_DYNAMICS,
        teaches="A stable oscillation remains after the path has ended.",
        source="Furuta, Yamakita and Kobayashi, Journal of Systems and Control Engineering 206 (1992) 263-269",
        number="The pendulum swings with 5.717 rad/s.",
        start={"theta": 0.0, "dtheta": 0.0},
        t_span=(0.0, 5.0),
    ),
    "ball-and-beam": Scene(
        partial(_built, "ball_and_beam"),
        "A beam tilts by a given angle, and a ball rolls down on it.",
        group=INTERNAL_DYNAMICS,
        teaches="The path of the ball itself would be singular at rest; the beam's angle is not.",
        source="Hauser, Sastry and Kokotović, IEEE Transactions on Automatic Control 37 (1992) 392-398",
        number="The ball's acceleration settles at 0.3502 m/s².",
        start={"r": 0.0, "dr": 0.0},
        t_span=(0.0, 2.0),
    ),
    "acrobot": Scene(
        partial(_built, "acrobot"),
        "A two-link gymnast stills a swing: the momentum about the bar is proportional to the angle of the hip.",
        group=INTERNAL_DYNAMICS,
        teaches="A program of momentum, a virtual nonholonomic constraint, takes energy out without a path in time.",
        source="The closed form, linearised about the hanging pose",
        number="The swing decays with 0.555 1/s.",
        start={"q1": -1.2, "q2": -0.2},
        t_span=(0.0, 16.0),
    ),
    "hopper": Scene(
        partial(_built, "hopper"),
        "A hopper in flight swings its leg and two arms; its trunk turns.",
        group=INTERNAL_DYNAMICS,
        teaches="Angular momentum is conserved: what the limbs do determines the trunk.",
        source="The closed form, the angular momentum about the centre of mass integrated once",
        number="The trunk turns by 0.6328 rad.",
        start={"x": 0.0, "z": 0.0, "phi": 0.0, "dx": 2.0, "dz": 2.45, "dphi": 0.0},
        t_span=(0.0, 0.5),
    ),
    # --- arms and robots
    "two-link-arm": Scene(
        partial(_built, "two_link_arm"),
        "The end point of an arm with two driven joints moves along a line, in gravity.",
        group=ARMS_AND_ROBOTS,
        teaches="As many motors as coordinates: inverse kinematics and inverse dynamics in one.",
        source="The closed form by the cosine rule",
        number="The elbow is bent by 1.721 rad at the start.",
        guess={"q1": -0.4, "q2": 1.5},
        t_span=(0.0, 2.0),
    ),
    "six-axis-arm": Scene(
        partial(_built, "six_axis_arm"),
        "The tool of an arm with six axes moves along a line and turns.",
        group=ARMS_AND_ROBOTS,
        teaches="A pose is six residuals; torques follow from a robot's description by inverse dynamics.",
        source="Luh, Walker and Paul, Journal of Dynamic Systems, Measurement, and Control 102 (1980) 69-76",
        number="At rest the second motor holds 32.69 N m.",
        guess={"pan": 0.3, "lift": 0.2, "elbow": 1.4, "roll": 0.2, "bend": 0.9, "turn": 0.4},
        t_span=(0.0, 3.0),
    ),
    "cable-robot": Scene(
        partial(_built, "cable_robot"),
        "Eight ropes move a platform; their tensions stay near a pretension.",
        group=ARMS_AND_ROBOTS,
        teaches="More actuators than residuals: of all tensions those nearest to a wish, which keeps every rope taut.",
        source="Pott, Cable-Driven Parallel Robots, Springer (2018)",
        number="The largest tension is 660.6 N.",
        t_span=(0.0, 4.0),
    ),
    "reaction-wheels": Scene(
        partial(_built, "reaction_wheels"),
        "Three reaction wheels turn a satellite by 120 degrees from rest to rest.",
        group=ARMS_AND_ROBOTS,
        teaches="Unit quaternion and body rates; the angular momentum of all bodies stays zero.",
        source="closed form: conservation of angular momentum",
        number="The third wheel reaches 65.45 rad/s.",
        start={"a1": 0.0, "a2": 0.0, "a3": 0.0, "s1": 0.0, "s2": 0.0, "s3": 0.0},
        guess={"e0": 1.0},
        t_span=(0.0, 20.0),
    ),
    "tumbling-satellite": Scene(
        partial(_built, "tumbling_satellite"),
        "Three torques take the energy out of a satellite's tumbling at a programmed rate.",
        group=ARMS_AND_ROBOTS,
        teaches="One residual for three torques: the generalised inverse weighted by the inertia realises it.",
        source="closed form, elliptic; the subject of Bajodah, thesis, Georgia Institute of Technology (2003)",
        number="After 20 s it turns about its second axis at 0.03807 rad/s.",
        start={"e1": 0.0, "e2": 0.0, "e3": 0.0, "w1": 0.25, "w2": 0.0},
        guess={"e0": 1.0, "w3": 0.35},
        t_span=(0.0, 20.0),
    ),
    # --- ideal reactions
    "appell-hamel": Scene(
        partial(_built, "appell_hamel"),
        "The Appell-Hamel mechanism, linear rolling constraints, ideal (Emami et al.).",
        group=IDEAL_REACTIONS,
        teaches="Constraints on velocities enter (3.18) without multipliers; the reaction follows afterwards.",
        number="The string's tension is at most 9.699 N.",
        **_APPELL_HAMEL,
    ),
    "two-cars-ideal": Scene(
        partial(_built, "cars", by="ideal"),
        "The same program by an ideal reaction, which acts on the first car: another motion.",
        group=IDEAL_REACTIONS,
        teaches="Who realises a program decides the motion: 6.85 N here, 316 N by the motor.",
        source="The closed form, a driven oscillator",
        number="The reaction is at most 6.852 N.",
        start={"x2": 0.0, "dx2": 0.0},
        t_span=(0.0, 2.0),
    ),
    "constant-speed": Scene(
        partial(_built, "constant_speed"),
        "A particle kept at constant speed in gravity by an ideal reaction.",
        group=IDEAL_REACTIONS,
        teaches="A constraint that is quadratic in velocities: its reaction is along the velocity.",
        source="The closed form, heading -arcsin tanh(g t/v)",
        number="After 1 s the particle has fallen by 3.283 m.",
        start={"x": 0.0, "y": 0.0, "dy": 0.0},
        guess={"dx": 5.0},
        t_span=(0.0, 1.0),
    ),
    "rolling-disc": Scene(
        partial(_built, "rolling_disc"),
        "A thin disc rolls on the ground in steady precession.",
        group=IDEAL_REACTIONS,
        teaches="Rolling as a program: three residuals of orders 0, 1 and 1 whose reactions do no work.",
        source="Appell, Rendiconti del Circolo Matematico di Palermo 14 (1900) 1-6; closed form",
        number="The centre goes around a circle of 1.044 m radius.",
        start=_PRECESSION,
        t_span=(0.0, 4.2),
    ),
    # --- higher orders
    "spiral": Scene(
        partial(_built, "spiral"),
        "A particle whose curvature grows steadily: Cornu's spiral, a program of order 3.",
        group=HIGHER_ORDERS,
        teaches="Residuals may contain any derivative; those above the second are states.",
        source="The closed form, Fresnel integrals",
        number="After 2 s the particle is at y = 0.6205 m.",
        start={"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0, "d2y": 0.0},
        t_span=(0.0, 2.0),
    ),
    "constant-jerk": Scene(
        partial(_built, "constant_jerk"),
        "A particle whose jerk keeps its magnitude, in gravity, by an ideal reaction.",
        group=HIGHER_ORDERS,
        teaches="Order 3, quadratic in the highest derivatives: a guess chooses one of two branches.",
        source="closed form: a cubic path",
        number="After 2 s it has gone 4.8 m sideways.",
        start={"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0, "d2x": 0.6, "d2y": -9.01},
        guess={"d3x": 1.2, "d3y": 1.6},
        t_span=(0.0, 2.0),
    ),
    "jerkless-trolley": Scene(
        partial(_built, "jerkless_trolley"),
        "A trolley with a swinging rod keeps the acceleration that it starts with, by an ideal reaction.",
        group=HIGHER_ORDERS,
        teaches="Under a constraint of order 3 the acceleration of a body is an initial value.",
        source="closed form, a pendulum in g - a; the subject of Liu, thesis, University of Cincinnati (1990)",
        number="The rod swings out to 0.7743 rad, twice the arctangent of a/g.",
        start={"x": 0.0, "dx": 0.0, "d2x": 4.0, "theta": 0.0, "dtheta": 0.0},
        t_span=(0.0, 2.5),
    ),
    "clothoid-arm": Scene(
        partial(_built, "clothoid_arm"),
        "The end of an arm of two links draws Cornu's spiral at constant speed.",
        group=HIGHER_ORDERS,
        teaches="Programs of orders 1 and 3 for one machine, realised by its motors.",
        source="Jarzębowska, Model-Based Tracking Control of Nonlinear Systems (CRC Press, 2012); Fresnel integrals",
        number="After 2 s the end is 0.4167 m from its start.",
        start={"q1": -0.6, "q2": 1.5, "dq1": -0.2, "d2q1": 0.22677037187619453},  # curvature 0
        guess={"dq2": 0.673, "d2q2": -0.283},
        t_span=(0.0, 2.0),
    ),
    "steady-satellite": Scene(
        partial(_built, "steady_satellite"),
        "A satellite's acceleration keeps its magnitude, by an ideal reaction of order 3.",
        group=HIGHER_ORDERS,
        teaches="A program that is linear in the rate of the acceleration, at distances of a million metres.",
        source="Soltakhanov, Yushkov and Zegzhda, Mechanics of Non-holonomic Systems (Springer, 2009)",
        number="The magnitude of the acceleration stays 8.135 m/s².",
        start={"x": 7e6, "y": 0.0, "dx": 0.0, "dy": 8266.372624, "d2y": 0.0},
        guess={"d2x": -8.134693877551021},
        t_span=(0.0, 8000.0),
    ),
    # --- rolling machines
    "wheeled-robot": Scene(
        partial(_built, "wheeled_robot"),
        "A wheeled robot turns by 90 degrees at constant speed; the rate of its path's curvature is programmed.",
        group=ROLLING_MACHINES,
        teaches="Quasi-velocities satisfy the rolling constraints; orders of residuals may differ.",
        source="The closed form, a curvature that grows and falls like 1 - cos",
        number="The curvature is at most 0.7854 1/m.",
        start={"x": 0.0, "y": 0.0, "psi": 0.0, "r": 0.0},
        guess={"v": 1.0},
        t_span=(0.0, 5.0),
    ),
    "trailers": Scene(
        partial(_built, "trailers"),
        "A wheeled robot pulls two trailers; the last one's curvature and speed are programmed.",
        group=ROLLING_MACHINES,
        teaches="Curvature of the last axle's path, a flat output, and its derivatives determine the steering.",
        source="Rouchon, Fliess, Lévine and Martin, IEEE Conference on Decision and Control (1993) 2700-2705",
        number="The robot comes to a circle of 2.298 m radius.",
        start={"X": 0.0, "Y": 0.0, "theta1": 0.0, "theta2": 0.0},
        guess={"v": 1.0},
        t_span=(0.0, 10.0),
    ),
    "ball-on-turntable": Scene(
        partial(_built, "ball_on_turntable"),
        "A motor turns a table at a constant rate; a ball rolls on it.",
        group=ROLLING_MACHINES,
        teaches="Rolling is two material constraints of order 1; the ball's circle has 2/7 of the table's rate.",
        source="closed form, as in Milne, Vectorial Mechanics (1948)",
        number="At 3 rad/s of the table the ball goes around at 0.8571 rad/s.",
        start={"x": 0.5, "y": 0.0, "dx": 0.0, "dy": 0.3, "alpha": 0.0, "beta": 0.0},
        t_span=(0.0, 8.0),
    ),
    "bicycle": Scene(
        partial(_built, "bicycle"),
        "The rear axle of a bicycle goes round a figure eight.",
        group=ROLLING_MACHINES,
        teaches="Rolling without slip is built into quasi-velocities, and the path into speed and curvature.",
        source="The closed form, the steering angle arctan(base × curvature)",
        number="The steering angle is at most 0.5824 rad.",
        start={"x": 0.0, "y": 0.0, "psi": 0.7853981633974483},
        guess={"v": 4.44},
        t_span=(0.0, 16.0),
    ),
    # --- singular programs
    "appell-hamel-squared": Scene(
        partial(_built, "appell_hamel", "squared"),
        "The paper's squared form (4.4): singular when the wheel stops, at 0.698 s.",
        group=SINGULAR_PROGRAMS,
        teaches="A squared residual loses its gradient where the velocity vanishes, and the motion ends in words.",
        number="The motion ends at 0.698 s.",
        **_APPELL_HAMEL,
    ),
    "constant-speed-horizontal": Scene(
        partial(_built, "constant_speed", "horizontal"),
        "The same program by a horizontal force: it ends at v/g = 0.510 s.",
        group=SINGULAR_PROGRAMS,
        teaches="An actuator that does not act along the velocity needs more and more force, up to a singularity.",
        source="The closed form, a force of -m g² t/sqrt(v² - g² t²)",
        number="The motion ends at 0.5097 s.",
        start={"x": 0.0, "y": 0.0, "dy": 0.0},
        guess={"dx": 5.0},
        t_span=(0.0, 1.0),
    ),
}
