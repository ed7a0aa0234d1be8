"""Measure what the inputs and hidden layers of policies tell about the drones that they fly.

Ridge regressions (Alain and Bengio, 2016, arXiv 1610.01644) from one observation, or one layer, to
what drawn drones can do, fitted to half of them; the table has R^2 of
the other half. ``python -m benchmarks.probe PRESET randomization.all=0.2 --policy FILE``
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.drones import reachable
from quadjax.cli import script
from quadjax.cli.options import ConfigName, Count, Overrides, PolicyFile, Seed
from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core import mlp
from quadjax.core.errors import InputError
from quadjax.core.markdown import table
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race import laps
from quadjax.race.environment import without_training_limits
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.summary import AXES, turns

WARM_UP, EVERY = 1.0, 0.1  # s, before the first of a flight's samples and between two
RIDGE = 1e-3  # penalty on the weights of inputs of unit variance


def quantities(model, constants) -> dict[str, np.ndarray]:
    """What drones can do: thrust-to-weight ratio, accelerations, limits, time constants."""
    constants = jax.tree.map(lambda x: np.asarray(x, np.float64), constants)
    values, ratio = values_of(constants), model.thrust_to_weight(constants)
    found = {} if ratio is None else {"thrust to weight": np.asarray(ratio)}
    turning = np.asarray(jax.vmap(functools.partial(turns, model))(constants)[0])
    found |= {f"{axis} acceleration": turning[:, index] for index, axis in enumerate(AXES)}
    found |= {name: values[name] for name in (*(name for _, name in model.ranges), *model.lags)}
    return {name: x for name, x in found.items() if x.ndim and np.ptp(x) > 0.0}


def sample(policy, config, drones, seconds, seed) -> tuple[np.ndarray, dict, dict]:
    """Drone (n,), inputs by source (n, k) and quantities by name (drones,) of all samples."""
    environment, params = pilot.adapt_race(*make_race(config.replace(schedules={})), policy)
    params = without_training_limits(environment.model, params)
    pilot_params = pilot.make_pilot(policy, deterministic=True)
    states = laps.starting_states(
        environment, params, jax.random.key(seed), drones, from_hover=True
    )
    if states.constants is None:
        raise InputError("randomization draws no constants, allowed: randomization.all=0.2")
    step = laps.stepper(environment, pilot.act, params, pilot_params)
    observe = jax.vmap(environment.observation, in_axes=(None, -1))
    rate = 1.0 / float(params.rules.time_step)

    def advance(race, count):
        def body(_, race):
            (after, _), _ = step((race, jax.random.key(0)))  # the race has no end
            return after.replace(lap_end=race.lap_end, over=after.crash_code != 0)

        return jax.lax.fori_loop(0, count, body, race)

    def record(race, _):
        seen = observe(params, race.state)
        return advance(race, round(EVERY * rate)), (seen, ~race.over)

    first, count = advance(laps.begin(states, 1), round(WARM_UP * rate)), 10 * seconds - 10
    seen, on = jax.jit(lambda race: jax.lax.scan(record, race, None, count))(first)[1]
    kept = np.asarray(on).reshape(-1)
    inputs = {"observation": jnp.reshape(seen, (len(kept), -1))[kept]}
    layers = mlp.to_layers(pilot_params.policy.params["actor"])
    for number, (kernel, bias) in enumerate(layers[:-1], start=1):
        last = list(inputs.values())[-1]
        inputs[f"layer {number}"] = mlp.ACTIVATIONS[policy.activation](last @ kernel + bias)
    drawn = reachable(environment.model, params.vehicle.constants, states.constants)
    return np.tile(np.arange(drones), count)[kept], inputs, quantities(environment.model, drawn)


def r_squared(drone, inputs, values) -> float:
    """R^2 of values (drones,) on the odd drones, of a ridge regression on the even ones."""
    fitted, target, inputs = drone % 2 == 0, values[drone], np.asarray(inputs, np.float64)
    x = (inputs - inputs[fitted].mean(axis=0)) / np.maximum(inputs[fitted].std(axis=0), 1e-9)
    mean, count = target[fitted].mean(), fitted.sum()
    gram = x[fitted].T @ x[fitted] / count + RIDGE * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x[fitted].T @ (target[fitted] - mean) / count)
    error = target[~fitted] - mean - x[~fitted] @ weights
    return float(1.0 - (error**2).mean() / target[~fitted].var())


def probe(config: ConfigName, /, *overrides: Overrides, policy: list[PolicyFile],
          drones: Count = 500, seconds: Count = 8, seed: Seed = 0) -> None:  # fmt: skip
    """Measure what inputs and layers tell, in ``seconds`` of flight of each of ``drones``."""
    race, rows = load_config(config, overrides), []
    for file in policy:
        drone, sources, values = sample(Policy.load(file, race), race, drones, seconds, seed)
        for source, inputs in sources.items():
            found = [f"{r_squared(drone, inputs, x):.2f}" for x in values.values()]
            rows.append([str(file), source, *found])
    print(table([["policy", f"R^2 of {drones // 2} drones, by", *values], *rows]))


if __name__ == "__main__":
    script(probe)
