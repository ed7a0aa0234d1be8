"""Speed of the environment and of training, without compilation."""

import dataclasses
import os
import platform
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from quadjax.config.race import build_params, choices_of
from quadjax.config.schema import Config
from quadjax.core.environment import Environment, vectorize, where_done
from quadjax.core.provenance import processor
from quadjax.learners import parallel
from quadjax.race.environment import RaceParams, make_environment
from quadjax.training.build import build_learner, start_state
from quadjax.vehicle.residual import Residual

STEPS_PER_CALL = 4_000_000  # environment steps in one timed call, about


@dataclasses.dataclass(frozen=True)
class Speed:
    """One measurement."""

    num_envs: int
    devices: int
    compile_seconds: float
    steps_per_second: float  # median over the repeats
    slowest: float  # steps/s of the slowest repeat
    fastest: float


def random_residual(seed: int = 0, width: int = 32) -> Residual:
    """Residual networks of the usual size with small random weights."""
    random = np.random.default_rng(seed)

    def layers(inputs: int, outputs: int, size: float) -> tuple:
        shapes = ((inputs, width, 0.1), (width, outputs, size))
        return tuple(
            (
                jnp.asarray(scale * random.normal(size=(rows, columns)), jnp.float32),
                jnp.zeros(columns, jnp.float32),
            )
            for rows, columns, scale in shapes
        )

    numbers = (jnp.float32(x) for x in (3000.0, 11000.0, 1.0))
    return Residual(layers(7, 1, 0.1), layers(10, 3, 1e-3), *numbers)


def _loop(environment: Environment, steps: int, observed: bool) -> Callable[..., tuple]:
    """Steps of all environments from a state, with a fresh one where an episode ends."""
    batched = vectorize(environment)
    step, observe = batched.step, batched.observe

    def loop(params: RaceParams, state: object, fresh: object, action: jax.Array) -> tuple:
        def one(carry: tuple, _: None) -> tuple[tuple, None]:
            state, total = carry
            following, reward, terminated, truncated = step(params, state, action)
            following = where_done(terminated | truncated, fresh, following)
            total = total + reward
            if observed:
                total = total + observe(params, following).sum(axis=1)
            return (following, total), None

        return jax.lax.scan(one, (state, jnp.zeros(action.shape[0])), None, steps)[0]

    return loop


def environment_loop(
    config: Config, params: RaceParams, num_envs: int, steps: int, devices: int, observed: bool
) -> tuple[Callable, tuple]:
    """A compiled loop of steps with automatic resets, split over devices, and its arguments.

    Args:
        config: of the race.
        params: its numbers; they are arguments of the loop, as in training.
        num_envs: number of environments.
        steps: of each drone in a call.
        devices: over which the environments are split.
        observed: whether every step makes the observation too.
    """
    environment = make_environment(choices_of(config))
    loop = _loop(environment, steps, observed)
    mesh = parallel.make_mesh(devices)
    reset = jax.jit(vectorize(environment).reset)
    state = reset(params, jax.random.split(jax.random.key(0), num_envs))
    shape = (num_envs, environment.action_size)
    action = jax.random.uniform(jax.random.key(1), shape, minval=-1.0, maxval=1.0)
    shared = PartitionSpec()
    split = parallel.split_last(state)
    specs = (shared, split, split, PartitionSpec(parallel.AXIS))
    sharded = jax.shard_map(
        loop,
        mesh=mesh,
        in_specs=specs,
        out_specs=(split, PartitionSpec(parallel.AXIS)),
        check_vma=False,
    )

    def place(tree: object, spec: object) -> object:
        return jax.tree.map(lambda x, s: jax.device_put(x, NamedSharding(mesh, s)), tree, spec)

    placed = place(state, split)
    arguments = (params, placed, placed, jax.device_put(action, NamedSharding(mesh, specs[3])))
    return jax.jit(sharded, compiler_options=parallel.compile_options()), arguments


def measure_environment(
    config: Config, num_envs: int, residual: bool, observed: bool, repeats: int
) -> Speed:
    """Environment steps a second: step, reset where an episode ended, and maybe the observation.

    Args:
        config: of the race.
        num_envs: number of environments; split over as many devices as divide them.
        residual: use random residual networks.
        observed: make the observation too.
        repeats: to take the median of.
    """
    params = build_params(config)
    if residual:
        vehicle = params.vehicle.replace(residual=random_residual())
        params = params.replace(vehicle=vehicle)
    devices = parallel.choose_devices("auto", num_envs)
    steps = min(20_000, max(50, STEPS_PER_CALL // num_envs))
    loop, arguments = environment_loop(config, params, num_envs, steps, devices, observed)
    began = time.perf_counter()
    compiled = loop.lower(*arguments).compile()
    compile_seconds = time.perf_counter() - began

    def call() -> None:
        jax.block_until_ready(compiled(*arguments))

    return _speed(call, num_envs * steps, repeats, num_envs, devices, compile_seconds)


def measure_training(config: Config, repeats: int) -> Speed:
    """Training steps a second of a config, from its first updates."""
    learner, params = build_learner(config), build_params(config)
    state = start_state(config, learner, params)
    mesh = parallel.choose_mesh(config.run.devices, state)
    state = parallel.place(state, mesh)
    updates = max(1, round(STEPS_PER_CALL / 10 / learner.steps_per_update))
    began = time.perf_counter()
    chunk = parallel.compile_chunk(learner, mesh, updates, params, state)
    compile_seconds = time.perf_counter() - began

    def call() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(chunk(params, state))

    steps = updates * learner.steps_per_update
    return _speed(call, steps, repeats, config.learner.num_envs, mesh.size, compile_seconds)


def _speed(
    call: Callable[[], None],
    steps: int,
    repeats: int,
    num_envs: int,
    devices: int,
    compile_seconds: float,
) -> Speed:
    call()  # the first call also touches memory for the first time
    speeds = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        speeds.append(steps / (time.perf_counter() - began))
    middle = statistics.median(speeds)
    return Speed(num_envs, devices, compile_seconds, middle, min(speeds), max(speeds))


def machine() -> dict[str, str | int | float | None]:
    """What this was measured on: processor, cores, memory, JAX and its device."""
    return {
        "processor": processor(),
        "cores": parallel.core_count(),
        "memory_gib": _memory_gib(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "backend": jax.default_backend(),
    }


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, OSError, ValueError):
        return None
