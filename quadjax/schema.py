"""The schema of a training config: every key, its default and the values it may take."""

import dataclasses
import math
from dataclasses import dataclass, field

from quadjax.errors import InputError


@dataclass(frozen=True)
class VehicleConfig:
    """The drone: which model, its constants (filled from ``file``) and its residual."""

    kind: str = "motor"  # motor (E2E) | rate (INDI)
    file: str = "bebop1.yaml"  # in configs/vehicles
    residual: str | None = None  # residual file (.npz) on top of the nominal model
    integrator: str = "euler"  # euler | rk4
    name: str = ""
    mass: float = 1.0  # kg, only to report newtons
    motor: dict[str, float] = field(default_factory=dict)
    rate: dict[str, float] = field(default_factory=dict)
    # Factors on constants of the drone that flies, where it is not the one that the policy and
    # its estimator know: {k_w: 0.96} for four per cent less thrust.
    actual: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class GateConfig:
    """One gate, world NED."""

    position: list[float] = field(default_factory=list)  # x, y, z, m
    yaw_deg: float = 0.0  # heading of the way through, deg
    size: list[float] = field(default_factory=lambda: [1.0, 1.0])  # width and height, m


@dataclass(frozen=True)
class TrackConfig:
    """The gates in flying order (filled from ``file``)."""

    file: str = "square4.yaml"  # in configs/tracks
    name: str = ""
    gates: list[GateConfig] = field(default_factory=list)


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the reward; the defaults are the published ones."""

    progress: float = 1.0  # per metre nearer to the target gate
    gate: float = 10.0  # per gate passed
    gate_offset: float = 10.0  # taken off per metre from its centre
    collision: float = 10.0  # taken off for a collision
    time: float = 0.0  # taken off per second
    rates: float = 0.0  # taken off per second and rad/s of body rate
    early: float = 0.0  # per second by which a gate is passed before its step ends


@dataclass(frozen=True)
class EpisodeConfig:
    """An episode: its clock, its limits, its start and what the policy is told."""

    dt: float = 0.01  # s
    max_steps: int = 1200
    gate_test: str = "square"  # square (the paper) | world_box (the authors' code)
    gate_margin: float = 0.0  # m taken off each side of a gate in training
    position_limit: float = 10.0  # m
    rate_limit: float = 1000.0  # rad/s
    pitch_limit_deg: float = 85.0  # in training
    roll_limit_deg: float = 180.0  # in training
    random_gate: bool = False  # start before any gate, not only the first
    stagger_clocks: bool = False  # start at a random step of the clock
    disturbance_input: str = "true"  # true | estimated | none: what the observation says
    wrap_next_yaw: bool = True  # false: the authors' code's plain difference


@dataclass(frozen=True)
class StartConfig:
    """Half-widths of the uniform start; the defaults are the paper's."""

    position: float = 0.5  # m
    velocity: float = 0.5  # m/s
    roll_pitch_deg: float = 40.0  # the authors' code: 20
    yaw_deg: float = 180.0
    rates: float = 1.0  # rad/s; the authors' code: 0.1
    thrust: list[float] = field(default_factory=lambda: [7.4, 7.6])  # m/s^2, rate-level vehicle


@dataclass(frozen=True)
class DisturbanceConfig:
    """Half-widths of the external disturbances, constant over an episode."""

    moment_x: float = 0.0  # N m; the paper: 0.03
    moment_y: float = 0.0  # N m; the paper: 0.03
    moment_z: float = 0.0  # N m; the paper: 0.01
    force_z: float = 0.0  # m/s^2; the paper: 0.5
    steady_moment: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])  # N m, always there

    @property
    def half_widths(self) -> dict[str, float]:
        """The ranges by name, without the steady part: what scales the observation."""
        return {name: value for name, value in vars(self).items() if name != "steady_moment"}


@dataclass(frozen=True)
class RandomiseConfig:
    """Domain randomisation: the fraction by which each constant of a group may be off."""

    gravity: float = 0.0
    inertia: float = 0.0
    thrust: float = 0.0
    drag: float = 0.0
    moment: float = 0.0
    velocity_moment: float = 0.0
    yaw: float = 0.0
    lag: float = 0.0
    limits: float = 0.0


@dataclass(frozen=True)
class NetworkConfig:
    """Separate policy and value networks."""

    hidden: list[int] = field(default_factory=lambda: [64, 64, 64])
    activation: str = "relu"  # relu | tanh
    log_std: float = 0.0  # at the start


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al., 2017)."""

    steps_per_update: int = 64  # steps of each drone before an update
    batches: int = 8  # per epoch
    epochs: int = 5
    shuffle_block: int = 0  # consecutive steps kept together when shuffling; 0: all of an update
    learning_rate: float = 7e-4
    final_learning_rate: float = 0.0  # reached linearly at the end
    adam_epsilon: float = 1e-5
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.0
    gradient_norm: float = 0.5
    separate_clip: bool = True  # clip the policy's and the value's gradients apart
    kl_limit: float = 0.03  # batches whose KL from the old policy is larger are skipped
    reward_scale: float = 1.0


@dataclass(frozen=True)
class SHACConfig:
    """Short-horizon actor-critic (Xu et al., 2022): gradients through the simulator."""

    horizon: int = 48  # steps of each drone per gradient
    learning_rate: float = 3e-3
    final_learning_rate: float = 1.5e-4  # reached linearly at the end
    adam_b1: float = 0.7
    adam_b2: float = 0.95
    gradient_norm: float = 1.0
    critic_learning_rate: float = 3e-3
    critic_gradient_norm: float = 1.0
    critic_passes: int = 4
    critic_batches: int = 4
    critic_target_rate: float = 0.2  # how fast the target critic follows
    td_lambda: float = 0.95
    discount: float = 0.99
    state_gradient_decay: float = 0.95  # per step, on its way back through the state
    state_gradient_clip: float = 0.02  # largest entry of the state's gradient
    std: float = 0.3  # of the actions while training
    final_std: float = 0.3
    reward_scale: float = 0.1


@dataclass(frozen=True)
class TrainConfig:
    """The training run."""

    drones: int = 1024
    steps: int = 40_000_000  # environment steps in all
    devices: str = "auto"  # auto | all | a number
    init: str | None = None  # policy file (.npz) to start from
    evaluate_every: int = 500_000  # steps between timed laps: one compiled chunk
    checkpoint_seconds: float = 20.0  # at least so long between checkpoints
    tensorboard: bool = False


@dataclass(frozen=True)
class EvaluateConfig:
    """Timed laps."""

    laps: int = 6
    runs: int = 5


@dataclass(frozen=True)
class Config:
    """All of it."""

    name: str = "run"  # results go to runs/NAME
    seed: int = 0
    algorithm: str = "ppo"  # ppo | shac
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    start: StartConfig = field(default_factory=StartConfig)
    disturbance: DisturbanceConfig = field(default_factory=DisturbanceConfig)
    randomise: RandomiseConfig = field(default_factory=RandomiseConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    shac: SHACConfig = field(default_factory=SHACConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)


CHOICES: dict[str, tuple[str, ...]] = {
    "algorithm": ("ppo", "shac"),
    "vehicle.kind": ("motor", "rate"),
    "vehicle.integrator": ("euler", "rk4"),
    "episode.gate_test": ("square", "world_box"),
    "episode.disturbance_input": ("true", "estimated", "none"),
    "network.activation": ("relu", "tanh"),
}
# Lowest and highest value, and whether each bound itself is allowed.
_UNIT = (0.0, 1.0)
CLOSED: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "ppo.gae_lambda": _UNIT,
    "shac.td_lambda": _UNIT,
    "shac.state_gradient_decay": _UNIT,
    "shac.critic_target_rate": _UNIT,
    "start.roll_pitch_deg": (0.0, 89.0),
    "start.yaw_deg": (0.0, 180.0),
    "episode.pitch_limit_deg": (1.0, 89.0),
    "episode.roll_limit_deg": (1.0, 180.0),
    **{f"randomise.{f.name}": (0.0, 0.9) for f in dataclasses.fields(RandomiseConfig)},
}
HALF_OPEN_DISCOUNT = ("ppo.discount", "shac.discount")  # [0, 1)
AT_LEAST_ONE = (
    "episode.max_steps",
    "ppo.steps_per_update",
    "ppo.batches",
    "ppo.epochs",
    "shac.horizon",
    "shac.critic_passes",
    "shac.critic_batches",
    "train.drones",
    "train.steps",
    "train.evaluate_every",
    "evaluate.laps",
    "evaluate.runs",
)
POSITIVE = (
    "vehicle.mass",
    "episode.dt",
    "episode.position_limit",
    "episode.rate_limit",
    "ppo.learning_rate",
    "ppo.adam_epsilon",
    "ppo.clip",
    "ppo.gradient_norm",
    "ppo.kl_limit",
    "ppo.reward_scale",
    "shac.learning_rate",
    "shac.gradient_norm",
    "shac.critic_learning_rate",
    "shac.critic_gradient_norm",
    "shac.state_gradient_clip",
    "shac.std",
    "shac.final_std",
    "shac.reward_scale",
)
NOT_NEGATIVE = (
    "episode.gate_margin",
    "start.position",
    "start.velocity",
    "start.rates",
    "disturbance.moment_x",
    "disturbance.moment_y",
    "disturbance.moment_z",
    "disturbance.force_z",
    "ppo.shuffle_block",
    "ppo.final_learning_rate",
    "ppo.value_coefficient",
    "ppo.entropy_coefficient",
    "shac.final_learning_rate",
    "train.checkpoint_seconds",
)


def value_at(config: object, key: str) -> object:
    """The value at a dotted key."""
    for part in key.split("."):
        config = getattr(config, part)
    return config


def check(config: Config) -> None:
    """Raise an ``InputError`` that names the key, the value and what is allowed."""
    _check_finite(config, "")
    for key, allowed in CHOICES.items():
        _require(config, key, value_at(config, key) in allowed, f"one of {', '.join(allowed)}")
    for key, (low, high) in CLOSED.items():
        _require(config, key, low <= value_at(config, key) <= high, f"{low} to {high}")
    for key in HALF_OPEN_DISCOUNT:
        _require(config, key, 0 <= value_at(config, key) < 1, "at least 0 and less than 1")
    for key in AT_LEAST_ONE:
        _require(config, key, value_at(config, key) >= 1, "at least 1")
    for key in POSITIVE:
        _require(config, key, value_at(config, key) > 0, "a positive number")
    for key in NOT_NEGATIVE:
        _require(config, key, value_at(config, key) >= 0, "not negative")
    _check_name(config)
    _check_lists(config)
    _check_sizes(config)


def _require(config: Config, key: str, fine: bool, allowed: str) -> None:
    if not fine:
        raise InputError(f"{key} is {value_at(config, key)!r}, allowed: {allowed}")


def _check_finite(node: object, prefix: str) -> None:
    for item in dataclasses.fields(node):
        value, key = getattr(node, item.name), f"{prefix}{item.name}"
        if dataclasses.is_dataclass(value):
            _check_finite(value, f"{key}.")
        values = value if isinstance(value, (list, tuple)) else [value]
        if any(isinstance(x, float) and not math.isfinite(x) for x in values):
            raise InputError(f"{key} is {value!r}, allowed: finite numbers")


def _check_name(config: Config) -> None:
    fine = bool(config.name) and all(c.isalnum() or c in "._-" for c in config.name)
    _require(config, "name", fine and not config.name.startswith("."), "letters, digits, . _ -")
    devices = config.train.devices
    fine = devices in ("auto", "all") or (devices.isdigit() and int(devices) >= 1)
    _require(config, "train.devices", fine, "auto, all, or a number from 1")


def _check_lists(config: Config) -> None:
    widths = config.network.hidden
    _require(config, "network.hidden", bool(widths) and min(widths) >= 1, "widths of at least 1")
    low_high = config.start.thrust
    fine = len(low_high) == 2 and 0 <= low_high[0] <= low_high[1]
    _require(config, "start.thrust", fine, "[lowest, highest], not negative")
    steady = config.disturbance.steady_moment
    fine = len(steady) == 3 and all(math.isfinite(x) for x in steady)
    _require(config, "disturbance.steady_moment", fine, "three finite numbers, N m")
    if not config.track.gates:
        raise InputError(f"track.gates is empty in {config.track.file}, expected one gate or more")
    for index, gate in enumerate(config.track.gates):
        for name, count in (("position", 3), ("size", 2)):
            value = getattr(gate, name)
            if len(value) != count or not all(math.isfinite(x) for x in value):
                raise InputError(
                    f"track.gates[{index}].{name} is {value}, expected {count} finite numbers"
                )
        if not math.isfinite(gate.yaw_deg):
            raise InputError(
                f"track.gates[{index}].yaw_deg is {gate.yaw_deg}, expected a finite number"
            )
        if min(gate.size) <= 2 * config.episode.gate_margin:
            raise InputError(
                f"track.gates[{index}].size is {gate.size}, expected more than twice the "
                f"episode.gate_margin {config.episode.gate_margin}"
            )


def _check_sizes(config: Config) -> None:
    ppo, shac, drones = config.ppo, config.shac, config.train.drones
    if config.algorithm == "ppo":
        block = ppo.shuffle_block or ppo.steps_per_update
        if ppo.steps_per_update % block:
            raise InputError(
                f"ppo.shuffle_block is {block}, expected a divisor of ppo.steps_per_update "
                f"{ppo.steps_per_update}"
            )
        blocks = drones * (ppo.steps_per_update // block)
        if blocks % ppo.batches:
            raise InputError(
                f"ppo.batches is {ppo.batches}, expected a divisor of the {blocks} blocks of "
                f"an update (train.drones {drones} x {ppo.steps_per_update // block})"
            )
    elif drones % shac.critic_batches:
        raise InputError(
            f"shac.critic_batches is {shac.critic_batches}, expected a divisor of train.drones "
            f"{drones}"
        )
