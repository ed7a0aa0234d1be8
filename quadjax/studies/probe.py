"""Linear probes: what a policy's inputs and hidden activations tell about the drone that it flies.

A ridge regression predicts what drawn drones can do (their thrust-to-weight ratio, say) from one
observation, or from the activations of one hidden layer (Alain and Bengio, 2016, arXiv 1610.01644).
It is fitted to the flights of one half of the drones; R^2 is that of the flights of the other half.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from quadjax.config.race import race_of
from quadjax.config.schema import Config
from quadjax.core import mlp
from quadjax.core.errors import InputError
from quadjax.core.markdown import table
from quadjax.core.plotting import INK, MUTED, SERIES, head, new_figure, tidy
from quadjax.fitting.least_squares import r_squared
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot
from quadjax.race import environment, laps
from quadjax.race.environment import Choices, RaceParams
from quadjax.studies.drawn_drones import check_drawn, quantities, reachable

WARM_UP, EVERY = 1.0, 0.1  # s, before the first sample of a flight and between two
RIDGE = 1e-3  # penalty on the weights of inputs of unit variance, part of the mean square
LEAST = 20  # drones with samples


@dataclasses.dataclass(frozen=True)
class Samples:
    """Samples of the flights of drawn drones.

    Attributes:
        drone: index (samples,) of the drone.
        inputs: (samples, n) by source: ``observation``, ``layer 1``, ..
        drones: quantities (drones,) by name.
    """

    drone: np.ndarray
    inputs: Mapping[str, np.ndarray]
    drones: Mapping[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Probe:
    """The probes of one policy.

    Attributes:
        label: of the policy.
        fitted: number of drones that the probes are fitted to.
        held_out: number of drones that they are evaluated on.
        r_squared: of the held-out samples, by source and quantity.
        true: quantities (samples,) of the held-out samples.
        predicted: their predictions (samples,), by source and quantity.
    """

    label: str
    fitted: int
    held_out: int
    r_squared: Mapping[str, Mapping[str, float]]
    true: Mapping[str, np.ndarray] = dataclasses.field(repr=False)
    predicted: Mapping[str, Mapping[str, np.ndarray]] = dataclasses.field(repr=False)

    def to_json(self) -> dict[str, Any]:
        """R^2 and the numbers of drones."""
        rounded = {
            source: {name: round(value, 4) for name, value in row.items()}
            for source, row in self.r_squared.items()
        }
        counts = {"fitted": self.fitted, "held_out": self.held_out}
        return {"policy": self.label, **counts, "r_squared": rounded}


def probe(
    policy: Policy,
    config: Config,
    drones: int = 500,
    seconds: int = 8,
    seed: int = 0,
    name: str = "policy",
) -> Probe:
    """Fly the mean action from hover on drawn drones and fit the probes.

    Args:
        policy: the policy.
        config: of the race, with a randomization.
        drones: number of drones.
        seconds: of a flight; the first one has no samples, nor has the time after a crash.
        seed: of the drones.
        name: of the policy, for messages.

    Raises:
        InputError: the policy does not fit the race, the config draws no constants, or fewer than
            ``LEAST`` flights last a second.
    """
    return fit_probes(sample(policy, config, drones, seconds, seed, name), name)


def sample(
    policy: Policy, config: Config, drones: int, seconds: int, seed: int, name: str
) -> Samples:
    """Samples of flights; arguments and errors as of ``probe``."""
    check_drawn(config)
    choices, params = pilot.fit_race(*race_of(config.replace(schedules={})), policy, name)
    choices = dataclasses.replace(choices, randomize=True)
    params = environment.exact_rules(choices.model, params)
    own = pilot.make_pilot(choices, params, policy, deterministic=True)
    race = _starts(choices, params, jax.random.key(seed), drones)
    step = float(params.rules.time_step)
    stride = max(1, round(EVERY / step))
    skipped, count = round(WARM_UP / step), round((seconds - WARM_UP) / step / stride)
    seen, flying = _fly(choices, skipped, stride, count, params, own, race)
    kept = np.asarray(flying).reshape(-1)
    index = np.tile(np.arange(drones), count)[kept]
    if len(np.unique(index)) < LEAST:
        raise InputError(
            f"{name}: {len(np.unique(index))} of {drones} flights last longer than {WARM_UP:g} s, "
            f"expected at least {LEAST}"
        )
    observed = jnp.asarray(np.asarray(seen).reshape(len(kept), -1)[kept])
    layers = mlp.hidden(own.policy.layers, observed, own.policy.activation)
    inputs = {"observation": observed}
    inputs |= {f"layer {number}": x for number, x in enumerate(layers, start=1)}
    drawn = reachable(choices.model, params.vehicle.constants, race.state.constants)
    found = {source: np.asarray(x, np.float64) for source, x in inputs.items()}
    return Samples(index, found, quantities(choices.model, drawn))


@functools.partial(jax.jit, static_argnums=(0, 3))
def _starts(choices: Choices, params: RaceParams, key: jax.Array, drones: int) -> laps.LapState:
    states = laps.starting_states(choices, params, key, drones, from_hover=True)
    return laps.begin(states, 1)


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _fly(
    choices: Choices,
    skipped: int,
    stride: int,
    count: int,
    params: RaceParams,
    own: Pilot,
    race: laps.LapState,
) -> tuple[jax.Array, jax.Array]:
    """What the policy observes (count, drones, n), and whether the flight is still on.

    The race has no end: laps are not counted.
    """
    one = laps.stepper(choices, pilot.fly, params, own)
    observe = jax.vmap(functools.partial(environment.observe, choices), in_axes=(None, -1))

    def advance(race: laps.LapState, steps: int) -> laps.LapState:
        def body(_: int, race: laps.LapState) -> laps.LapState:
            (after, _), _ = one((race, jax.random.key(0)))
            return after.replace(lap_end=race.lap_end, over=after.crash != 0)

        return jax.lax.fori_loop(0, steps, body, race)

    def record(race: laps.LapState, _: None) -> tuple[laps.LapState, tuple[jax.Array, jax.Array]]:
        seen = jax.vmap(pilot.see, in_axes=(None, 0))(own, observe(params, race.state))
        return advance(race, stride), (seen, ~race.over)

    return jax.lax.scan(record, advance(race, skipped), None, count)[1]


def fit_probes(samples: Samples, label: str) -> Probe:
    """Fit each quantity to each kind of input, on the drones of even index.

    Args:
        samples: of flights.
        label: of the policy.
    """
    own = samples.drone % 2 == 0
    true = {name: values[samples.drone] for name, values in samples.drones.items()}
    targets = np.stack(list(true.values()), axis=1)
    scores, predicted = {}, {}
    for source, inputs in samples.inputs.items():
        found = ridge(inputs[own], targets[own], inputs[~own])
        score = r_squared(targets[~own], found)
        scores[source] = dict(zip(true, score.tolist(), strict=True))
        predicted[source] = dict(zip(true, found.T, strict=True))
    fitted, held_out = (len(np.unique(samples.drone[part])) for part in (own, ~own))
    kept = {name: values[~own] for name, values in true.items()}
    return Probe(label, fitted, held_out, scores, kept, predicted)


def ridge(inputs: np.ndarray, targets: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Predictions (k, targets) of a ridge regression with an intercept.

    Args:
        inputs: (m, n), which are scaled to unit variance; constant ones have no weight.
        targets: (m, targets).
        others: inputs (k, n) of the predictions.
    """
    mean, spread = inputs.mean(axis=0), inputs.std(axis=0)
    scale = np.where(spread > 1e-9, 1.0 / np.maximum(spread, 1e-9), 0.0)
    x, y = (inputs - mean) * scale, targets - targets.mean(axis=0)
    gram = x.T @ x / len(x) + RIDGE * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x.T @ y / len(x))
    return (others - mean) * scale @ weights + targets.mean(axis=0)


def probe_table(probes: Sequence[Probe]) -> str:
    """R^2 of the held-out drones as Markdown, a row for each policy and source."""
    titles = ["policy", "source", *next(iter(probes[0].r_squared.values()))]
    rows = [
        [each.label, source, *(f"{value:.2f}" for value in scores.values())]
        for each in probes
        for source, scores in each.r_squared.items()
    ]
    return table([titles, *rows])


def probe_figure(probes: Sequence[Probe]) -> Figure:
    """R^2 by source, and predictions of the first quantity by the source that predicts it best."""
    name = next(iter(probes[0].true))
    figure = new_figure(4.6 + 3.4 * len(probes), 4.2)
    panels = figure.subplots(1, 1 + len(probes), width_ratios=[4.6, *([3.4] * len(probes))])
    _bars(panels[0], probes, name)
    for axes, each, color in zip(panels[1:], probes, _colors(probes), strict=True):
        scores = {source: row[name] for source, row in each.r_squared.items()}
        best = max(scores, key=lambda source: scores[source])
        true, predicted = each.true[name], each.predicted[best][name]
        axes.plot(true, predicted, ".", color=color, markersize=2, alpha=0.15, rasterized=True)
        ends = [true.min(), true.max()]
        axes.plot(ends, ends, color=INK, linewidth=1)
        margin = 0.15 * (ends[1] - ends[0])
        axes.set_ylim(ends[0] - margin, ends[1] + margin)
        axes.set_xlabel(name, color=INK)
        axes.set_ylabel(f"predicted from {best}", color=INK)
        tidy(axes)
        head(axes, f"{each.label}: R² {scores[best]:.2f}")
    return figure


def _colors(probes: Sequence[Probe]) -> list[str]:
    return [SERIES[index % len(SERIES)] for index in range(len(probes))]


def _bars(axes: Any, probes: Sequence[Probe], name: str) -> None:
    tidy(axes)
    width = 0.8 / len(probes)
    for index, (each, color) in enumerate(zip(probes, _colors(probes), strict=True)):
        heights = [row[name] for row in each.r_squared.values()]
        places = np.arange(len(heights)) + width * (index - 0.5 * (len(probes) - 1))
        axes.bar(places, heights, 0.92 * width, color=color, label=each.label)
    sources = max((list(each.r_squared) for each in probes), key=len)
    axes.set_xticks(range(len(sources)), sources)
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    axes.set_ylim(min(0.0, axes.get_ylim()[0]), 1.0)
    axes.set_ylabel(f"R² of {name}, held-out drones", color=INK)
    axes.grid(False, axis="x")
    head(axes, columns=2)
