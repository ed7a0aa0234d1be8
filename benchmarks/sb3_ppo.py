"""Stable-Baselines3's PPO of ``benchmarks.against_sb3``."""

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

import quadjax
from quadjax.integrations.sb3 import RaceVecEnv


def make_ppo(config: quadjax.Config, env: VecEnv | None = None) -> PPO:
    """Stable-Baselines3's PPO with the hyperparameters of a config, on its race or on ``env``."""
    learner, hidden = config.learner, list(config.network.hidden)
    activation = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[config.network.activation]
    return PPO(
        "MlpPolicy",
        env or RaceVecEnv(*quadjax.make_race(config), learner.num_envs, config.seed),
        learning_rate=learner.learning_rate,
        n_steps=learner.rollout_length,
        batch_size=learner.num_envs * learner.rollout_length // learner.num_minibatches,
        n_epochs=learner.num_epochs,
        gamma=learner.discount,
        gae_lambda=learner.gae_lambda,
        clip_range=learner.clip_range,
        ent_coef=learner.entropy_coefficient,
        vf_coef=learner.value_coefficient,
        max_grad_norm=learner.max_grad_norm,
        policy_kwargs={
            "net_arch": {"pi": hidden, "vf": hidden},
            "activation_fn": activation,
            "log_std_init": learner.initial_log_std,
        },
        seed=config.seed,
        device="cpu",
    )
