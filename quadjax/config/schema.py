"""The training config: its sections, which declare each key with default, bounds and description.

Lengths are in m, velocities in m/s, angles in deg where the name says so and in rad otherwise. The
world frame is north-east-down, the body frame front-right-down.
"""

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import SerializeAsAny

from quadjax.core.errors import InputError
from quadjax.core.section_keys import with_value
from quadjax.core.sections import (
    MAX_GATES,
    MAX_LAPS,
    MAX_RUNS,
    MAX_SEED,
    ORDERED,
    Code,
    Field,
    FolderName,
    Needs,
    Section,
)
from quadjax.core.yaml_files import to_yaml
from quadjax.learners.learner import Learner, Network
from quadjax.learners.ppo import PPO
from quadjax.learners.schedules import Curriculum, Schedule
from quadjax.race.draws import Disturbance, Randomization, Start
from quadjax.race.observation_config import Observation
from quadjax.race.rewards import Reward
from quadjax.race.rules import Rules, TrainingLimits
from quadjax.race.track import TrackSection
from quadjax.vehicle.battery import BatteryConfig

Constant = Annotated[float, Field(ge=-1e9, le=1e9)]
Delay = Annotated[float, Field(ge=0, le=0.1)]
Devices = Annotated[int, Field(ge=1, le=4096)]
SCORE_NAMES = {  # columns of metrics.csv, by ``run.score``
    "mean": "lap_total",
    "sampled": "lap_total",
    "reward": "episode_reward",
}


class Vehicle(Section):
    """The drone: its model, constants and residual."""

    model: Annotated[str, Code()] = Field(
        "motor",
        description="dynamics: motor (commands are four propeller speeds; E2E), rate (body rates "
        "and thrust; INDI), racing or a2rl (normalized motor commands), or the "
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
        description="width of the drone from tip to tip of diagonally opposite propellers, m: "
        "every gate's opening must be larger",
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
    residual_gain: Annotated[float, Needs("vehicle.residual")] = Field(
        1.0, ge=0, le=10, description="factor on the outputs of the residual networks"
    )
    quaternion: bool = Field(
        False,
        description="attitude as a quaternion in place of Euler angles, which are singular at a "
        "pitch of 90 deg; models racing and a2rl have one in any case",
    )
    integrator: Literal["euler", "rk4"] = Field("euler", description="integration of a time step")
    delay: Annotated[tuple[Delay, Delay], ORDERED] | None = Field(
        None,
        description="delay of commands, s: lowest and highest, drawn for every episode of "
        "training; timed laps have their mean; at most rules.time_step",
    )
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
            listed, name = ", ".join([self.model, *self.models]), self.name or "the vehicle"
            raise InputError(
                f"vehicle.models has no constants for {model}: {name} has constants of {listed}; "
                "add them to its file"
            )
        others = {name: values for name, values in self.models.items() if name != model}
        others[self.model] = self.constants
        return self.replace(model=model, constants=self.models[model], models=others, mismatch={})


class Run(Section):
    """The training run."""

    steps: int = Field(
        40_000_000, ge=1, le=10**12, description="environment steps, of all environments together"
    )
    devices: Literal["auto", "all"] | Devices = Field(
        "auto", description="number of devices, or auto, or all"
    )
    initial_policy: str | None = Field(
        None, description="policy file (.npz) to start from, next to the config or by its path"
    )
    evaluate_every: int = Field(
        500_000, ge=1, le=10**12, description="environment steps between evaluations (one chunk)"
    )
    score: Literal["mean", "sampled", "reward"] = Field(
        "mean",
        description="flights by which the best policy is chosen and that metrics.csv reports: lap "
        "times of the mean action, or sampled with the noise of training; or rewards of the mean "
        "action in episodes from random starts",
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

    @property
    def score_name(self) -> str:
        """The column of the score in ``metrics.csv``."""
        return SCORE_NAMES[self.score]


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
        description="best known lap of quadjax limit, s: lap tables and the metrics of training "
        "then have gap, the fraction by which the fastest lap of the flights is slower",
    )

    @property
    def length(self) -> str:
        """The length of a run as text: 6 laps, or 19 gates."""
        number, unit = (self.laps, "lap") if self.gates is None else (self.gates, "gate")
        return f"{number} {unit}{'s' * (number != 1)}"


class Config(Section):
    """A training run on a race."""

    IN_FILES: ClassVar = {"gates": "track=FILE", "mass": "vehicle=FILE"}

    name: FolderName = Field("run", description="name of the run; results are written to runs/NAME")
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of all random numbers of training")
    vehicle: Vehicle = Vehicle()
    track: TrackSection
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
    learner: SerializeAsAny[Learner] = Field(PPO(), description="hyperparameters of the algorithm")
    curriculum: Curriculum = Curriculum()
    schedules: dict[str, Schedule] = Field(
        {},
        max_length=100,
        description="numbers that change during training, by dotted key: {learner.std: {linear: "
        "[0.3, 0.05], from: 0.5}}",
    )
    run: Run = Run()
    evaluate: Evaluate = Evaluate()

    def at(self, key: str, value: Any) -> Self:
        """The config with another value at a dotted key; see ``with_value``."""
        return with_value(self, key, value)

    def to_yaml(self) -> str:
        """The whole config as YAML, which ``load`` reads back without any other file."""
        return to_yaml(self.model_dump(by_alias=True))
