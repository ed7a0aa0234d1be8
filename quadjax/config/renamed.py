"""Keys of configs written for version 0.1, with their present names."""

from typing import Any

from quadjax.core.errors import InputError
from quadjax.core.yaml_files import Tree

_SECTIONS: dict[str, dict[str, Any]] = {
    "vehicle": {
        "kind": "vehicle.model",
        "motor": "vehicle.constants (those of the chosen model)",
        "rate": "vehicle.constants (those of the chosen model)",
        "actual": "vehicle.mismatch",
        "mass": None,
    },
    "reward": {
        "rates": "reward.body_rates",
        "onward": "reward.next_gate_progress",
        "edge": "reward.gate_edge",
        "edge_margin": "reward.gate_edge_margin",
    },
    "episode": {
        "dt": "rules.time_step",
        "gate_test": "rules.gate_test",
        "position_limit": "rules.position_limit",
        "rate_limit": "rules.body_rate_limit",
        "max_steps": "training_limits.episode_steps",
        "pitch_limit_deg": "training_limits.pitch_deg",
        "roll_limit_deg": "training_limits.roll_deg",
        "yaw_rate_limit": "training_limits.yaw_rate",
        "gate_margin": "training_limits.gate_inflation (with the opposite sign)",
        "random_gate": "start.gate (first or random)",
        "stagger_clocks": "start.stagger_clocks",
        "disturbance_input": "observation.disturbance (ground_truth, estimated or none)",
        "wrap_next_yaw": "observation.wrap_next_yaw",
    },
    "start": {"rates": "start.body_rates"},
    "disturbance": {"steady_moment": "disturbance.moment_bias"},
    "network": {"log_std": "learner.initial_log_std"},
    "ppo": {
        "steps_per_update": "learner.rollout_length",
        "batches": "learner.num_minibatches",
        "epochs": "learner.num_epochs",
        "clip": "learner.clip_range",
        "gradient_norm": "learner.max_grad_norm",
        "separate_clip": "learner.separate_grad_clip",
        "kl_limit": "learner.max_kl",
        "warm_up": "learner.critic_warmup",
        "final_learning_rate": "schedules: {learner.learning_rate: {linear: [value, 0.0]}}",
    },
    "shac": {
        "gradient_norm": "learner.max_grad_norm",
        "critic_gradient_norm": "learner.critic_max_grad_norm",
        "critic_passes": "learner.critic_epochs",
        "critic_batches": "learner.critic_minibatches",
        "critic_target_rate": "learner.target_update_rate",
        "state_gradient_decay": "learner.cotangent_decay",
        "state_gradient_clip": "learner.cotangent_clip",
        "mean_rate": "learner.ema_rate",
        "warm_up": "learner.critic_warmup",
        "final_learning_rate": "schedules: {learner.learning_rate: {linear: [value, 1.5e-4]}}",
        "final_discount": "schedules: {learner.discount: {linear: [value, 0.995]}}",
        "final_std": "schedules: {learner.std: {linear: [value, 0.05]}}",
    },
    "train": {
        "drones": "learner.num_envs",
        "shares": "run.shards",
        "init": "run.initial_policy",
        "residual_ramp": "schedules: {vehicle.residual_gain: {linear: [0, 1], from: .., "
        "until: ..}}",
        "yaw_ramp": "start.heading=inside_turn with schedules: {start.yaw_deg: {linear: [0, 180], "
        "from: .., until: ..}}",
        "edge_ramp": "schedules: {reward.gate_edge: {linear: [0, value], from: .., until: ..}}",
        "nose_up_price": "reward.pitch_up with schedules: {reward.pitch_up: {linear: [value, 0]}}",
    },
}
_RENAMED_SECTIONS = {
    "ppo": "learner",
    "shac": "learner",
    "train": "run",
    "randomise": "randomization",
}
_RETIRED = {"learner": {"revisit": 0.0}}  # keys without effect at this value, in stored configs


def without_retired(tree: Tree) -> Tree:
    """The tree without keys that no longer exist, where their value had no effect."""
    return {
        section: {
            key: value
            for key, value in values.items()
            if key not in _RETIRED[section] or value != _RETIRED[section][key]
        }
        if section in _RETIRED and isinstance(values, dict)
        else values
        for section, values in tree.items()
    }


def check_renamed(tree: Tree, source: str) -> None:
    """Reject a key of an earlier version, with its present name.

    Raises:
        InputError: the first such key.
    """
    if "algorithm" in tree:
        raise InputError(f"{source}: algorithm is now learner.algorithm")
    for section, values in tree.items():
        known, other = _SECTIONS.get(section, {}), _RENAMED_SECTIONS.get(section)
        if known and "." not in section and other is None and not isinstance(values, dict):
            continue
        for key in values if isinstance(values, dict) else ():
            new = known.get(key, f"{other}.{key}" if other else key)
            if new is None:
                raise InputError(f"{source}: {section}.{key} no longer exists: it had no effect")
            if new != key:
                raise InputError(f"{source}: {section}.{key} is now {new}")
        if other:
            raise InputError(f"{source}: section {section} is now {other}")
