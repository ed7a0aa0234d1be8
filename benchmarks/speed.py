"""Measure the speed of the environment and of training, without compilation (make benchmark).

Environment steps a second with the reset of finished episodes, the same with the observation for
each vehicle model, and training steps a second. Every measurement runs in a separate process: the
median of its repeats, in brackets the slowest. docs/design/simulator.md has numbers.
"""

import multiprocessing
import os
import re
import statistics
import timeit

from quadjax.cli import options, script
from quadjax.core.errors import InputError
from quadjax.core.resources import find_config

FORM = re.compile(r"training:\w+:\d{1,8}|(environment|observed):\w+:[1-9]\d{0,7}")
STEPS_PER_CALL = 4_000_000  # environment steps in one timed call, about
JOBS = [f"environment:e2e:{number}" for number in (1, 64, 4096, 65_536)]
JOBS += [f"observed:{vehicle}:4096" for vehicle in ("bebop1", "5inch", "a2rl")]
JOBS += [f"training:{preset}:0" for preset in ("e2e", "e2e_ppo", "e2e_paper")]


def environment_loop(config, num_envs: int, observed: bool) -> tuple:
    """Steps of environments with automatic resets, split over devices, and their number."""
    import jax
    import jax.numpy as jnp
    from jax.sharding import PartitionSpec

    from quadjax.config.assembly import make_environment, make_params
    from quadjax.core.environment import Vectorized, where_done
    from quadjax.learners import parallel

    environment, params = make_environment(config), make_params(config)
    batched, steps = Vectorized(environment), min(20_000, max(50, STEPS_PER_CALL // num_envs))

    def loop(params, state, fresh, action):
        def one(carry, _):
            after, reward, terminated, truncated = batched.step(params, carry[0], action)
            after = where_done(terminated | truncated, fresh, after)
            seen = batched.observe(params, after).sum(axis=1) if observed else 0.0
            return (after, carry[1] + reward + seen), None

        return jax.lax.scan(one, (state, jnp.zeros(action.shape[0])), None, steps)[0]

    state = jax.jit(batched.reset)(params, jax.random.split(jax.random.key(0), num_envs))
    action = jax.random.uniform(jax.random.key(1), (num_envs, environment.action_size), minval=-1.0)
    split, rows = parallel.split_last(state), PartitionSpec(parallel.AXIS)
    specs = {"in_specs": (PartitionSpec(), split, split, rows), "out_specs": (split, rows)}
    specs["mesh"] = parallel.make_mesh(parallel.choose_devices("auto", num_envs))
    sharded = jax.shard_map(loop, **specs, check_vma=False)
    compiled = jax.jit(sharded, compiler_options=parallel.compile_options())
    return lambda: jax.block_until_ready(compiled(params, state, state, action)), steps * num_envs


def training_loop(config) -> tuple:
    """Some updates of a preset's training, and the environment steps in them."""
    import jax

    from quadjax.learners import parallel
    from quadjax.training.build import make_training, start_state

    training, plan = make_training(config)
    first = start_state(config, training)
    mesh = parallel.choose_mesh(config.run.devices, first)
    state = [parallel.place(first, mesh)]
    updates = max(1, round(STEPS_PER_CALL / 10 / plan.steps_per_update))
    chunk = parallel.compile_chunk(training, mesh, updates, state[0])

    def call():
        state[0] = jax.block_until_ready(chunk(state[0]))[0]

    return call, updates * plan.steps_per_update


def measure(kind: str, name: str, number: str, repeats: int) -> str:
    """One measurement, in this process: "environment", "observed" or "training"."""
    from quadjax.config.loading import load_config
    from quadjax.learners.parallel import prepare_devices

    observed, training, envs = kind == "observed", kind == "training", int(number)
    words = [f"learner.num_envs={number}"] * (training and envs > 0)
    config = load_config("e2e", [f"vehicle={name}"]) if observed else load_config(name, words)
    prepare_devices("auto")
    call, steps = training_loop(config) if training else environment_loop(config, envs, observed)
    call()  # compiles, and touches memory for the first time
    times = [timeit.timeit(call, number=1) for _ in range(repeats)]
    speed, time_step = steps / statistics.median(times), config.rules.time_step
    speeds = f"{speed:,.0f} ({steps / max(times):,.0f}) steps/s, {speed * time_step:,.0f} simulated"
    job = f"{kind:>12} {name:>10} {envs or config.learner.num_envs:>8,}"
    return f"{job} {speeds} s/s at {1.0 / time_step:.0f} Hz"


def speed(repeats: options.Count = 3, /, *jobs: str) -> None:
    """Measure all jobs, or KIND:NAME:ENVIRONMENTS .. (training: 0 for the preset's number)."""
    for job in jobs:
        if not FORM.fullmatch(job):
            raise InputError(f"{job}: allowed: (environment|observed|training):NAME:ENVIRONMENTS")
        find_config(job.split(":")[1], "vehicles" if job.startswith("observed") else "")
    print(f"{os.cpu_count()} cores")
    for job in jobs or JOBS:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            print(pool.apply(measure, (*job.split(":"), repeats)), flush=True)


if __name__ == "__main__":
    script(speed)
