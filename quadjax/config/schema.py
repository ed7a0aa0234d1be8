"""The schema of a training config: every key, its default and the values it may take."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class VehicleConfig:
    """The drone: which model, its constants (filled from ``file``) and its residual."""

    kind: str = "motor"  # motor (E2E) | rate (INDI)
    file: str = "bebop1.yaml"  # in configs/vehicles
    residual: str | None = None  # residual file (.npz), or the name of a shipped one
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
    # Per metre of the passing step, to the gate's centre and then to the next one's; in the weight
    # of progress, a leg sums to the same wherever its gates are passed.
    onward: float = 0.0
    edge: float = 0.0  # taken off per metre beyond the safe part of a gate's opening, passed or hit
    edge_margin: float = 0.1  # m between the safe part and each edge of the opening


@dataclass(frozen=True)
class EpisodeConfig:
    """An episode: its clock, its limits, its start and what the policy is told."""

    dt: float = 0.01  # s
    max_steps: int = 1200
    gate_test: str = "square"  # square (the paper) | world_box (the authors' code)
    # m taken off each side of a gate in training; below zero, added: what would have hit flies on,
    # at the price of reward.edge or gate_offset, and is no crash in the metrics of training.
    # Evaluation knows only the rule.
    gate_margin: float = 0.0
    position_limit: float = 10.0  # m
    rate_limit: float = 1000.0  # rad/s
    pitch_limit_deg: float = 85.0  # in training
    roll_limit_deg: float = 180.0  # in training; 180: none
    yaw_rate_limit: float = 1000.0  # rad/s, in training; 1000: none
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
    warm_up: int = 0  # updates of the value alone, for a policy from train.init


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
    final_discount: float | None = None  # reached linearly at the end; null: the same throughout
    state_gradient_decay: float = 0.95  # per step, on its way back through the state
    state_gradient_clip: float = 0.02  # largest entry of the state's gradient
    std: float = 0.3  # of the actions while training
    final_std: float = 0.3
    reward_scale: float = 0.1
    # Of the running mean of the policy, which is flown and kept; 1: the policy itself. The mean is
    # never over more than a twentieth of the updates so far.
    mean_rate: float = 1.0
    warm_up: int = 0  # updates of the value alone, for a policy from train.init


@dataclass(frozen=True)
class TrainConfig:
    """The training run."""

    drones: int = 1024
    steps: int = 40_000_000  # environment steps in all
    devices: str = "auto"  # auto | all | a number, of each process
    shares: int = 8  # a power of two: at most so many devices may share the drones
    init: str | None = None  # policy file (.npz) to start from
    # What grows in from nothing between two numbers of environment steps of this run: the vehicle's
    # residual, the yaw (up to half a turn) by which a start may be turned away from the inside of
    # the track's bend, and reward.edge.
    residual_ramp: list[float] = field(default_factory=lambda: [0.0, 0.0])
    yaw_ramp: list[float] = field(default_factory=lambda: [0.0, 0.0])
    # Taken off the reward per second and rad of pitch: in full until yaw_ramp begins, nothing from
    # its end on (a shorter run ends with some of it) nor where there is none.
    nose_up_price: float = 0.0
    edge_ramp: list[float] = field(default_factory=lambda: [0.0, 0.0])
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
