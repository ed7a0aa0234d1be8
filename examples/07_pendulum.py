"""SHAC and PPO on an environment that is not a race: swing up a pendulum and hold it there."""

import jax
import jax.numpy as jnp

import quadjax

DT = 0.05  # s


class Pendulum(quadjax.Environment):
    observation_size, action_size = 3, 1

    def reset(self, params, key):
        angle, rate = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return {"angle": jnp.pi * angle, "rate": rate, "clock": jnp.zeros((), jnp.int32)}

    def observe(self, params, state):
        return jnp.stack([jnp.cos(state["angle"]), jnp.sin(state["angle"]), 0.2 * state["rate"]])

    def step(self, params, state, action):
        torque = params["torque"] * jnp.tanh(action[0])
        rate = state["rate"] + DT * (params["gravity"] * jnp.sin(state["angle"]) + torque)
        angle, clock = state["angle"] + DT * rate, state["clock"] + 1
        reward = jnp.cos(angle) - 0.01 * rate**2  # 1 where it stands still and upright
        state, truncated = {"angle": angle, "rate": rate, "clock": clock}, clock >= 100
        return state, reward, jnp.zeros((), bool), truncated


def main():
    params = {"gravity": jnp.float32(9.81), "torque": jnp.float32(12.0)}
    learners = {
        "SHAC": quadjax.SHAC(num_envs=64, horizon=24, cotangent_clip=1.0),
        "PPO": quadjax.PPO(num_envs=64, rollout_length=50, reward_scale=0.1),
    }
    for name, learner in learners.items():
        result = learner.train(Pendulum(), params, steps=300_000)
        reward = result.metrics["reward"]
        print(f"{name}: mean reward {reward[0]:.2f} at first, {reward[-5:].mean():.2f} at the end")


if __name__ == "__main__":
    main()
