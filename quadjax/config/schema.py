"""The training config: every key with its default, unit, bounds and description.

Lengths are in m, velocities in m/s, angles in deg where the name says so and in rad otherwise. The
world frame is north-east-down, the body frame front-right-down.
"""

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import PrivateAttr, SerializeAsAny

from quadjax.core.errors import InputError
from quadjax.core.limits import MAX_GATES, MAX_LAPS, MAX_RUNS, MAX_SEED
from quadjax.core.sections import Field, FolderName, Section, Unit
from quadjax.core.yaml_files import to_yaml
from quadjax.learners.ppo.hyperparameters import PPO
from quadjax.learners.section import Curriculum, LearnerSection, Network, Schedule
from quadjax.race.random_track import RandomTrack, RandomTracks
from quadjax.vehicle.battery import BatteryConfig

if TYPE_CHECKING:
    from quadjax.vehicle.protocol import VehicleModel

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Constant = Annotated[float, Field(ge=-1e9, le=1e9)]
Span = tuple[Coordinate, Coordinate]
Fraction = Annotated[float, Field(ge=0, le=0.9)]
Devices = Annotated[int, Field(ge=1, le=4096)]
HalfWidth = Annotated[float, Field(ge=0, le=1e6)]
Rate = Annotated[float, Field(gt=0, le=1e6)]
Weight = Annotated[float, Field(ge=-1e6, le=1e6)]
Penalty = Annotated[float, Field(ge=0, le=1e6)]
Location = tuple[str | int, ...]  # of a value in a tree: keys, and indices of lists
WithUnit = dict[Location, tuple[str, float | int]]  # numbers in units of the race: text, number


class Vehicle(Section):
    """The drone: its model, constants and residual."""

    model: str = Field(
        "motor",
        description="dynamics: motor (commands are four propeller speeds; E2E), rate (body rates "
        "and thrust; INDI), racing or a2rl (normalized motor commands), rotor_thrust, or the "
        "module:OBJECT of your own VehicleModel; a vehicle file may name it",
    )
    file: str | None = Field(
        None,
        description="YAML file with the name and the constants, next to the config or in "
        "configs/vehicles; loading copies its values into the config and sets this to null "
        "(default: bebop1.yaml)",
    )
    name: str = Field("", description="name of the drone, for tables and figures")
    width: float = Field(
        0.0,
        ge=0,
        le=100,
        description="width of the drone from edge to edge, m: every gate's opening must be larger",
    )
    fitted_speed: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="highest speed of the flights that the constants are fitted to, m/s; quadjax "
        "limit reports how long a flight is faster; null: unknown",
    )
    constants: dict[str, Constant] = Field(
        {},
        max_length=100,
        description="physical constants of the chosen model, each overrides that of the file",
    )
    models: dict[str, Annotated[dict[str, Constant], Field(max_length=100)]] = Field(
        {},
        max_length=100,
        description="constants of the file's other models, for a later vehicle.model",
    )
    residual: str | None = Field(
        None,
        description="residual networks: a residual or policy file (.npz), next to the config or by "
        "its path, or the name of a shipped one",
    )
    residual_gain: float = Field(
        1.0, ge=0, le=10, description="factor on the outputs of the residual networks"
    )
    quaternion: bool = Field(
        False,
        description="attitude as a quaternion in place of Euler angles, which are singular at a "
        "pitch of 90 deg; models racing, a2rl and rotor_thrust have one in any case",
    )
    integrator: Literal["euler", "rk4"] = Field("euler", description="integration of a time step")
    mismatch: dict[str, Annotated[float, Field(gt=0, le=100)]] = Field(
        {},
        max_length=100,
        description="factors on constants of the simulated drone that policy and estimator do not "
        "know of: {k_w: 0.96} for 4% less thrust",
    )

    def with_model(self, model: str) -> "Vehicle":
        """The vehicle with another model that its file has constants of.

        Raises:
            InputError: the file has none.
        """
        if model == self.model:
            return self
        if model not in self.models:
            raise InputError(f"vehicle.models has no constants for {model}; it has {self.models}")
        others = {name: values for name, values in self.models.items() if name != model}
        others[self.model] = self.constants
        return self.replace(model=model, constants=self.models[model], models=others, mismatch={})


class Gate(Section):
    """One gate, in the world frame."""

    position: tuple[Coordinate, Coordinate, Coordinate] = Field(
        description="center x, y, z, m; z < 0 is above 0"
    )
    yaw_deg: float = Field(0.0, ge=-720, le=720, description="direction of passage, deg")
    size: tuple[Annotated[float, Field(gt=0, le=100)], Annotated[float, Field(gt=0, le=100)]] = (
        Field((1.0, 1.0), description="width and height of the opening, m")
    )
    pitch_deg: float = Field(
        0.0, ge=-90, le=90, description="upward slope of the passage, deg: -90 is straight down"
    )
    roll_deg: float = Field(
        0.0, ge=-180, le=180, description="rotation of the opening about the passage, deg"
    )
    shape: Literal["rectangle", "circle"] = Field(
        "rectangle", description="shape of the opening; a circle has size [diameter, diameter]"
    )

    @property
    def axes(self) -> list[list[float]]:
        """The matrix with columns through the gate, along its width and along its height, NED."""
        angles = [math.radians(x) for x in (self.roll_deg, self.pitch_deg, self.yaw_deg)]
        (sr, sp, sy), (cr, cp, cy) = map(math.sin, angles), map(math.cos, angles)
        return [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]


class TrackStart(Section):
    """Where a timed race starts."""

    position: tuple[Coordinate, Coordinate, Coordinate] = Field(description="x, y, z, m")
    yaw_deg: float = Field(0.0, ge=-720, le=720, description="heading, deg")


class Track(Section):
    """The gates, in the order of passage."""

    file: str | None = Field(
        None,
        description="YAML file with the name and the gates, next to the config or in "
        "configs/tracks; loading copies its values into the config and sets this to null "
        "(default: square4.yaml)",
    )
    generate: RandomTrack | None = Field(
        None,
        description="random track in place of gates: {seed, gates, leg, leg_ratio, turn_deg, "
        "yaw_deg, height, size, frame, split_s}; loading writes its gates into the config and sets "
        "this to null",
    )
    name: str = Field("", description="name of the track, for tables and figures")
    gates: tuple[Gate, ...] = Field(
        min_length=1,
        max_length=100,
        description="list of {position, yaw_deg, size, pitch_deg, roll_deg, shape}",
    )
    opening: float | None = Field(
        None,
        gt=0,
        le=100,
        description="width and height of the openings of all gates, m, in place of their sizes; "
        "the outer edges of frames (rules.gate_frame) stay; loading writes the sizes into the "
        "gates and sets this to null",
    )
    start: TrackStart | None = Field(
        None,
        description="{position, yaw_deg} of the hover from which timed laps start; null: the last "
        "gate's center, nose towards the first gate",
    )
    closed: bool = Field(
        True,
        description="whether the first gate follows the last; false: a course, which ends at the "
        "last gate and needs a start",
    )


class History(Section):
    """Fields of the observation that are also observed as they were in earlier steps."""

    fields: tuple[str, ...] = Field(
        (),
        max_length=6,
        description="names of observed fields: position, velocity, attitude (or rotation), rates, "
        "actuators (or their own name: rpm, rotor_speed, thrust), or last_action",
    )
    steps: int = Field(4, ge=1, le=16, description="number of earlier values of each")
    every: int = Field(
        4,
        ge=1,
        le=16,
        description="control steps from one to the next; steps * every is at most 64",
    )

    @property
    def lags(self) -> tuple[int, ...]:
        """How many steps before each of the values is, the latest first."""
        return tuple(self.every * (i + 1) for i in range(self.steps))


class Observation(Section):
    """What the policy observes."""

    disturbance: Literal["ground_truth", "estimated", "none"] = Field(
        "ground_truth",
        description="source of the observed external disturbance: the simulator, the onboard "
        "estimator, or zeros",
    )
    highest_rpm: Literal["ground_truth", "estimated", "none"] = Field(
        "estimated",
        description="source of the observed limit of the propeller speeds, with a battery: as of "
        "disturbance; none: it is not observed",
    )
    attitude: Literal["euler", "rotation"] = Field(
        "euler",
        description="roll, pitch and the yaw relative to the gate (3), or the body's x and z axes "
        "in the gate's frame (6), which have no singularity",
    )
    gates_ahead: int = Field(
        1,
        ge=1,
        le=4,
        description="number of gates after the target whose position and yaw are observed",
    )
    last_action: bool = Field(
        False, description="observe the action of the step before, -1 to 1; 0 at the start"
    )
    actuators: bool = Field(
        True,
        description="observe the actuators' state; false: for drones that do not measure it",
    )
    actuator_range: Span | None = Field(
        None,
        description="actuator states that are observed as -1 and 1, in the model's unit; null: "
        "their nominal range (arXiv 2504.21586: [0, 3000] rad/s)",
    )
    wrap_next_yaw: bool = Field(
        True,
        description="wrap the next gate's relative yaw to +-180 deg; the authors' code does not",
    )
    history: History | None = Field(
        None,
        description="earlier values that are observed too: {fields: [rates, rpm], steps: 4, "
        "every: 4} for those of 4, 8, 12 and 16 steps before; at a start, the first ones; null: "
        "none",
    )
    constants: bool = Field(
        False,
        description="the policy observes the constants of the drone that randomization draws: for "
        "drones whose constants are known",
    )
    critic_constants: bool = Field(
        False,
        description="the critic, not the policy, also observes the constants that randomization "
        "draws; the policy file then has no critic",
    )
    extra: tuple[str, ...] = Field(
        (), max_length=32, description="further fields, each the module:FIELD of your own Field"
    )


class Reward(Section):
    """Weights of the reward terms; the defaults are the published ones."""

    progress: Annotated[Weight, Unit("1/m")] = Field(
        1.0, description="reward per m of progress to the target gate"
    )
    gate: Weight = Field(10.0, description="reward per gate passed")
    gate_offset: Annotated[Weight, Unit("1/m")] = Field(
        10.0, description="penalty per m from the gate's center on passing"
    )
    collision: Weight = Field(10.0, description="penalty for a collision")
    time: Annotated[Weight, Unit("1/s")] = Field(0.0, description="penalty per s")
    body_rates: Weight = Field(0.0, description="penalty per s and rad/s of body rate")
    pitch_up: Annotated[Penalty, Unit("1/s")] = Field(
        0.0, description="penalty per s and rad of pitch (nose up)"
    )
    next_gate_progress: Annotated[Penalty, Unit("1/m")] = Field(
        0.0,
        description="reward per m of progress to the next gate within the step that passes a gate; "
        "equal to progress, a leg's reward does not depend on where its gates are passed",
    )
    gate_edge: Annotated[Penalty, Unit("1/m")] = Field(
        0.0, description="penalty per m of clearance violation on crossing the gate's plane"
    )
    gate_edge_margin: Annotated[Penalty, Unit("m")] = Field(
        0.1, description="required clearance from each edge of a gate's opening, m"
    )
    gate_edge_reach: Annotated[Penalty, Unit("m")] = Field(
        1.0,
        description="clearance violation in each axis from which on the penalty is constant, m; at "
        "least that at the edge of a widened opening",
    )
    action_change: Penalty = Field(
        0.0,
        description="penalty per change of an action from step to step, each in -1 to 1, summed",
    )
    perception: Annotated[Penalty, Unit("1/s")] = Field(
        0.0,
        description="penalty per s and rad of the angle between the camera's axis and the target "
        "gate's center beyond perception_deg",
    )
    perception_deg: float = Field(60.0, ge=0, le=180, description="angle without penalty, deg")
    camera_deg: float = Field(
        0.0, ge=-90, le=90, description="upward tilt of the camera's axis from the body's x, deg"
    )
    overspeed: Penalty = Field(
        20.0,
        description="penalty per s and m/s of speed above the margin below rules.speed_limit, as a "
        "multiple of reward.progress; above 1, flying faster gains less than it loses",
    )
    overspeed_margin: float = Field(
        0.03, ge=0, le=0.9, description="part of rules.speed_limit from which on overspeed applies"
    )
    terms: dict[str, Weight] = Field(
        {}, max_length=100, description="weights of your own reward terms, by module:function"
    )


class Rules(Section):
    """The rules of the race, in training and evaluation."""

    time_step: float = Field(
        0.01, ge=1e-4, le=0.1, description="time between two commands and of the simulation, s"
    )
    gate_test: Literal["square", "world_box", "interpolated"] = Field(
        "square",
        description="what counts as passing: within the opening at the first sample past its plane "
        "(the paper), within a box along the world axes there (the authors' code), or within the "
        "opening where the line between two samples crosses the plane",
    )
    body_radius: float = Field(
        0.0,
        ge=0,
        le=50,
        description="radius of the drone, m, by which openings, bounds and ground are closer",
    )
    position_limit: float | None = Field(
        10.0, gt=0, le=1e6, description="largest |x| and |y|, m; null: none"
    )
    bounds: tuple[Span, Span, Span] | None = Field(
        None,
        description="[lowest, highest] x, y and z, m: leaving the box is a collision; a z of -7 is "
        "a ceiling at 7 m; null: only position_limit and the ground",
    )
    ground_speed: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="largest speed within ground_height of the ground, m/s, so that races can "
        "start on it; null: touching the ground is a collision",
    )
    ground_height: float = Field(0.4, ge=0, le=100, description="see ground_speed, m")
    gate_frame: float = Field(
        0.0,
        ge=0,
        le=10,
        description="width of the solid frame around the opening of every gate, m; 0: a collision "
        "only where the plane of the target gate is crossed outside its opening",
    )
    gate_depth: float = Field(
        0.1, gt=0, le=10, description="depth of the frames, half of it on each side, m"
    )
    body_rate_limit: Rate | tuple[Rate, Rate, Rate] | None = Field(
        1000.0,
        description="largest body rate about any axis, or [p, q, r] about each, rad/s; null: none",
    )
    speed_limit: float | None = Field(
        None, gt=0, le=1000, description="largest speed, m/s, above which a flight ends; null: none"
    )
    extra: tuple[str, ...] = Field(
        (), max_length=32, description="your own rules that end an episode, as module:function"
    )

    @property
    def largest_body_rates(self) -> tuple[float, float, float]:
        """Largest p, q and r, rad/s; infinity where there is no limit."""
        limit = math.inf if self.body_rate_limit is None else self.body_rate_limit
        return limit if isinstance(limit, tuple) else (limit, limit, limit)


class TrainingLimits(Section):
    """Limits that apply in training only."""

    episode_steps: Annotated[int, Unit("steps")] = Field(
        1200, ge=1, le=10**6, description="time steps of an episode"
    )
    pitch_deg: float | None = Field(
        None,
        ge=1,
        le=89,
        description="largest |pitch|, deg; null: 85 for models with Euler angles, which are "
        "singular at 90, and none for those with quaternions",
    )
    roll_deg: float | None = Field(None, ge=1, le=180, description="largest |roll|, deg")
    yaw_rate: Annotated[float | None, Unit("1/s")] = Field(
        None, gt=0, le=1e6, description="largest |yaw rate|, rad/s"
    )
    gate_inflation: Annotated[float, Unit("m")] = Field(
        0.0,
        ge=-50,
        le=50,
        description="widening of every gate's opening on each side, m; negative: narrowing",
    )

    def largest_pitch_deg(self, model: "VehicleModel") -> float | None:
        """The largest pitch in training with a vehicle model, deg; None: any."""
        if self.pitch_deg is None and math.isfinite(model.pitch_limit):
            return 85.0
        return self.pitch_deg


class Start(Section):
    """The uniform distribution of an episode's start; the defaults are the paper's."""

    gate: Literal["first", "random"] = Field(
        "first", description="target of a start: the first gate or any; starts at the one before it"
    )
    heading: Literal["north", "inside_turn"] = Field(
        "north", description="center of the start's yaw: north, or to the inside of the turn"
    )
    stagger_clocks: bool = Field(
        False, description="start at a random step of the episode's clock, so that resets spread"
    )
    along_leg: float = Field(
        0.0,
        ge=0,
        le=1,
        description="farthest start on the way from the gate before to the target gate, as a "
        "fraction of it; the way is a cubic curve that leaves and enters the gates along their "
        "yaw; starts are uniform up to there",
    )
    race: float | None = Field(
        None,
        ge=0,
        le=1,
        description="part of the episodes that begin as a race: at rest at the track's start (or "
        "in the last gate), x and y within 0.5 m, yaw within 45 deg; null: 0.1 where the track's "
        "start is on the ground, else 0",
    )
    position: Annotated[HalfWidth, Unit("m")] = Field(
        0.5, description="half-width about the point on the leg, m"
    )
    velocity: Annotated[HalfWidth, Unit("m/s")] = Field(
        0.5, description="half-width of each component, m/s"
    )
    roll_pitch_deg: float = Field(40.0, ge=0, le=89, description="half-width of roll and pitch")
    yaw_deg: float = Field(180.0, ge=0, le=180, description="half-width of yaw about the heading")
    body_rates: Annotated[HalfWidth, Unit("1/s")] = Field(
        1.0, description="half-width of each component, rad/s"
    )
    thrust: tuple[HalfWidth, HalfWidth] = Field(
        (7.4, 7.6), description="lowest and highest thrust, m/s^2; model rate"
    )


class Disturbance(Section):
    """External disturbances, drawn per episode and constant in it."""

    moment_x: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.03"
    )
    moment_y: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.03"
    )
    moment_z: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.01"
    )
    force_z: HalfWidth = Field(0.0, description="half-width, m/s^2; the paper: 0.5")
    moment_bias: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="moment added in every episode, in the unit of moment_x, body"
    )

    @property
    def half_widths(self) -> dict[str, float]:
        """The drawn ranges by name, without the bias: what scales the observation."""
        return {key: value for key, value in self.__dict__.items() if key != "moment_bias"}


class Randomization(Section):
    """Domain randomization: largest relative error of each constant, drawn in every episode.

    A constant has the fraction of its group or that of ``all``, whichever is larger.
    """

    all: Fraction = Field(0.0, description="every constant of the groups except gravity")
    gravity: Fraction = Field(0.0, description="g")
    inertia: Fraction = Field(0.0, description="moments of inertia")
    thrust: Fraction = Field(0.0, description="thrust coefficient, or mass")
    drag: Fraction = Field(0.0, description="drag coefficients")
    moment: Fraction = Field(0.0, description="roll and pitch moment coefficients")
    velocity_moment: Fraction = Field(0.0, description="moments of translational flight")
    yaw: Fraction = Field(0.0, description="yaw moment coefficients")
    lag: Fraction = Field(0.0, description="time constants")
    limits: Fraction = Field(0.0, description="lowest and highest commands or rotor speeds")
    motor_map: Fraction = Field(0.0, description="curvature of the motor map; models racing, a2rl")
    gyroscopic: Fraction = Field(0.0, description="gyroscopic coupling; model a2rl")
    aerodynamics: Fraction = Field(
        0.0, description="quadratic drag, angle of attack and advance; model a2rl"
    )
    constants: dict[str, Fraction] = Field(
        {},
        max_length=100,
        description="fractions of single constants, which override their group: {w_max: 0.15}",
    )

    population: str | None = Field(
        None,
        description="population of the model that all constants are drawn from, in place of "
        "fractions: all_racing_drones (model racing; arXiv 2504.21586), monorace_fastest or "
        "monorace_robust (model a2rl; arXiv 2601.15222)",
    )
    width: float = Field(
        1.0,
        ge=0,
        le=1,
        description="factor on all fractions, and on the difference between a drone of the "
        "population and the nominal one; schedule it for a curriculum",
    )
    tracks: RandomTracks | None = Field(
        None,
        description="random tracks, one of which is drawn for every training episode in place of "
        "track: count and the keys of track.generate; flights of evaluations are on track",
    )

    @property
    def drawn(self) -> bool:
        """Whether constants are drawn."""
        return any(v for key, v in self.__dict__.items() if key not in ("width", "tracks"))

    def by_constant(self, model: "VehicleModel") -> dict[str, float]:
        """The fraction of each constant of a vehicle model."""
        found = dict.fromkeys(model.constant_names, 0.0)
        for group, names in model.groups.items():
            least = 0.0 if group == "gravity" else self.all
            found |= dict.fromkeys(names, max(getattr(self, group), least))
        return {name: self.width * part for name, part in (found | self.constants).items()}


class Run(Section):
    """The training run."""

    steps: int = Field(
        40_000_000, ge=1, le=10**12, description="environment steps, of all environments together"
    )
    devices: Literal["auto", "all"] | Devices = Field(
        "auto", description="number of devices, or auto, or all"
    )
    initial_policy: str | None = Field(
        None,
        description="policy file (.npz) to start from, next to the config or by its path",
    )
    start_states: str | None = Field(
        None,
        description="file of states (.npz) in which episodes of training start, next to the config "
        "or by its path; quadjax improve and quadjax limit --npz write such files",
    )
    start_states_part: float = Field(
        0.5, ge=0, le=1, description="part of the episodes that start in run.start_states"
    )
    evaluate_every: int = Field(
        500_000, ge=1, le=10**12, description="environment steps between evaluations (one chunk)"
    )
    score: Literal["mean", "sampled"] = Field(
        "mean",
        description="flights by which the best policy is chosen and that metrics.csv reports: of "
        "the mean action, or sampled with the noise of training",
    )
    checkpoint_seconds: float = Field(
        20.0, ge=0, le=1e6, description="least time between two checkpoints, s"
    )
    tensorboard: bool = Field(False, description="write TensorBoard events")
    compilation_cache: bool = Field(
        True,
        description="keep compiled programs in the user's cache folder, so that the next start "
        "compiles nothing; JAX_COMPILATION_CACHE_DIR sets another folder",
    )


class Evaluate(Section):
    """Timed laps after training."""

    laps: int = Field(6, ge=1, le=MAX_LAPS, description="laps of a run")
    gates: int | None = Field(
        None,
        ge=1,
        le=MAX_GATES,
        description="gates of a run in place of laps: 19 on split_s are two laps and five gates",
    )
    runs: int = Field(5, ge=1, le=MAX_RUNS, description="runs")
    best_known_lap: float | None = Field(
        None,
        gt=0,
        le=1e4,
        description="best known lap of quadjax limit, s: the metrics of training then have gap, "
        "the fraction by which the fastest lap of the scored flights is slower",
    )

    @property
    def length(self) -> str:
        """The length of a run as text: 6 laps, or 19 gates."""
        number, unit = (self.laps, "lap") if self.gates is None else (self.gates, "gate")
        return f"{number} {unit}{'s' * (number != 1)}"


class Config(Section):
    """A training run on a race."""

    name: FolderName = Field(
        "run",
        description="of the run; results are written to runs/NAME",
    )
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of all random numbers of training")
    vehicle: Vehicle = Vehicle()
    track: Track
    observation: Observation = Observation()
    reward: Reward = Reward()
    rules: Rules = Rules()
    training_limits: TrainingLimits = TrainingLimits()
    start: Start = Start()
    disturbance: Disturbance = Disturbance()
    battery: BatteryConfig | None = Field(
        None,
        description="battery that limits the propeller speeds, model motor: {charge: [lowest, "
        "highest], ..}, drawn in every episode and observed; null: none",
    )
    randomization: Randomization = Randomization()
    network: Network = Network()
    learner: SerializeAsAny[LearnerSection] = Field(
        PPO(), description="hyperparameters of the algorithm"
    )
    curriculum: Curriculum = Curriculum()
    schedules: dict[str, Schedule] = Field(
        {},
        max_length=100,
        description="numbers that change during training, by dotted key: {learner.std: {linear: "
        "[0.3, 0.05], from: 0.5}}",
    )
    run: Run = Run()
    evaluate: Evaluate = Evaluate()
    _race_units: WithUnit = PrivateAttr({})

    def __eq__(self, other: object) -> bool:
        """Whether all values are equal, however they are written."""
        return isinstance(other, Config) and self.__dict__ == other.__dict__

    def at(self, key: str, value: Any) -> Self:
        """The config with another value at a dotted key.

        Raises:
            InputError: no such key, or a value that is not allowed.
        """
        return _at(self, key.split("."), value)

    def replace(self, **changes: Any) -> Self:
        """A changed copy, as ``Section.replace``; it keeps its units if the race has the same."""
        copy = super().replace(**changes)
        return copy.with_race_units(self._race_units) if copy._scale == self._scale else copy

    @property
    def _scale(self) -> tuple[Any, ...]:
        """What the units of the race depend on."""
        return self.track, self.vehicle.model, self.vehicle.constants, self.rules.time_step

    def with_race_units(self, numbers: WithUnit) -> Self:
        """The config, whose file has these numbers in units of the race."""
        copy = self.model_copy()
        copy._race_units = numbers
        return copy

    @property
    def race_units(self) -> WithUnit:
        """The numbers that the config's file has in units of the race."""
        return self._race_units

    def to_tree(self) -> dict[str, Any]:
        """The whole config as plain values, numbers in units of the race as text."""
        return _written(self.model_dump(by_alias=True), (), self._race_units)

    def to_yaml(self) -> str:
        """The whole config as YAML, which ``load`` reads back without any other file."""
        return to_yaml(self.to_tree())


def _written(node: Any, location: Location, numbers: WithUnit) -> Any:
    """A tree with the text of each number in units of the race that has still the same value."""
    if isinstance(node, dict):
        return {key: _written(value, (*location, key), numbers) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [_written(item, (*location, index), numbers) for index, item in enumerate(node)]
    text, number = numbers.get(location, (None, None))
    return node if text is None or node != number else text


def _at(node: Section | dict[str, Any], parts: list[str], value: Any) -> Any:
    head, rest = parts[0], parts[1:]
    if isinstance(node, dict):
        return {**node, ".".join(parts): value}
    if rest:
        value = _at(getattr(node, head, {}), rest, value)
    return node.replace(**{head: value})
