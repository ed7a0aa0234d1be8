"""Drawn constants: of every rotor, and of published populations, against the printed numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import quadjax
from quadjax.config.assembly import make_params
from quadjax.config.schema import Randomization
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.racing import A2RL
from tests.race.support import compiled_reset, make_config, make_race

TRACK, COUNT = "track=figure8_tudelft", 4000
A2RL_RACE = ("vehicle=a2rl", TRACK)
MOMENTS = [f"{name}{rotor}" for name in ("k_p", "k_q", "k_r", "k_rd") for rotor in (1, 2, 3, 4)]
# Percent of the constants in monorace_fastest and monorace_robust.
PRINTED = (
    (("k_w",), 15, 50),
    (("k_x", "k_y"), 20, 50),
    (("k_x2", "k_y2", "k_angle", "k_hor"), 45, 50),
    (MOMENTS, 45, 50),
    (("j_x", "j_y", "j_z"), 50, 50),
    (("w_min",), 20, 50),
    (("w_max",), 15, 40),
    (("k",), 45, 50),
    (("tau",), 30, 55),
)


def independent(table):
    assert np.abs(np.corrcoef(table) - np.eye(len(table))).max() < 0.08


@pytest.mark.parametrize("name", ["monorace_fastest", "monorace_robust"])
def test_populations_of_the_a2rl_drone(name):
    config = make_config(*A2RL_RACE, f"randomization.population={name}")
    nominal = {key: np.float64(value) for key, value in config.vehicle.constants.items()}
    names, robust = A2RL.constant_names, name == "monorace_robust"
    numbers = np.random.default_rng(0).uniform(-1, 1, (COUNT, len(names))).astype(np.float32)
    base = A2RL.make_constants({key: jnp.float32(value) for key, value in nominal.items()})
    drones = values_of(jax.vmap(A2RL.populations[name], in_axes=(None, 0))(base, numbers))
    center = nominal | ({"tau": 0.025} if robust else {})
    spread = {key: row[1 + robust] / 100 for row in PRINTED for key in row[0]}
    table = []
    for index, key in enumerate(names):
        values = np.broadcast_to(np.asarray(drones[key], np.float64), COUNT)
        wanted = center[key] * (1 + spread.get(key, 0) * numbers[:, index].astype(np.float64))
        np.testing.assert_allclose(values, wanted, rtol=1e-5)
        table += [values / center[key]] if key in spread and center[key] else []
    independent(table)  # each drawn alone


def test_every_rotor_has_its_own_draw():
    own = ("randomization.all=0.3", "randomization.constants={k_w: 0.1, tau: 0}")
    environment, params = make_race("vehicle=5inch", TRACK, *own)
    drawn = values_of(compiled_reset(environment)(params, jax.random.key(0), COUNT).constants)
    nominal, spread = values_of(params.vehicle.constants), {"k_w": 0.1, "tau": 0.0, "g": 0.0}
    factors = {name: np.asarray(x) / float(nominal[name]) for name, x in drawn.items()}
    for name, values in factors.items():
        half = 0.0 if name.startswith("turning") else spread.get(name, 0.3)
        ends = [values.min(), values.max()]
        np.testing.assert_allclose(ends, [1 - half, 1 + half], atol=2e-3)
    independent([factors[name] for name in MOMENTS[:12]])


def test_population_of_all_racing_drones():
    """The ranges of arXiv 2504.21586, with the sums and products that it draws."""
    environment, params = make_race(
        "vehicle=5inch", TRACK, "randomization.population=all_racing_drones"
    )
    drawn = compiled_reset(environment)(params, jax.random.key(1), COUNT).constants
    c = {name: np.asarray(value, float) for name, value in values_of(drawn).items()}
    w = c["w_max"]
    for values, low, high in (
        (c["w_min"], 0, 500),
        (w, 3000, 5000),
        (c["k"], 0, 1),
        (c["tau"], 0.01, 0.1),
        (c["k_w"] * w**2, 10, 30),
        (c["k_x"] * w, 0.1, 0.3),
        (c["k_y"] * w, 0.1, 0.3),
        (c["k_r3"] * w, 20, 80),
        (c["k_rd2"] * w, 2, 8),
        ((c["k_p1"] - c["k_p4"]) * w**2, -100, 100),
        (np.mean([c[f"k_q{i}"] for i in (1, 2, 3, 4)], axis=0) * w**2, 200, 800),
    ):
        assert abs(values.min() - low) < 0.06 * (high - low)
        assert abs(values.max() - high) < 0.06 * (high - low)
    np.testing.assert_array_equal(c["k_r1"], c["k_r4"])
    np.testing.assert_array_equal(c["turning2"], 1.0)


def test_the_width_scales_every_draw():
    half = make_config("randomization={all: 0.2, lag: 0.4, constants: {k_w: 0.1}, width: 0.5}")
    environment, params = quadjax.make_race(half)
    spread = params.randomization.by_constant(environment.model, np.maximum)
    found = [float(spread[name]) for name in ("k_w", "tau", "k_x")]
    assert found == pytest.approx([0.05, 0.2, 0.1])
    environment, params = make_race(*A2RL_RACE, "randomization.population=monorace_fastest")
    key, widths = jax.random.key(0), (0.0, 0.25, 1.0)
    none, some, whole = (
        compiled_reset(environment)(
            params.replace(randomization=params.randomization.replace(width=np.float32(width))),
            key,
            4,
        ).constants.k_hor
        for width in widths
    )
    np.testing.assert_allclose(none, 7.245, rtol=1e-6)
    np.testing.assert_allclose(some, 0.75 * none + 0.25 * whole, rtol=1e-6)
    assert np.ptp(whole) > 0.1 and float(params.randomization.width) == 1.0
    curriculum = "schedules.randomization.width={linear: [0, 1], until: 0.5}"
    config = make_config(*A2RL_RACE, "randomization.population=monorace_robust", curriculum)
    assert float(make_params(config.at("randomization.width", 0.25)).randomization.width) == 0.25
    assert not Randomization(width=0.5).drawn and Randomization(lag=0.1).drawn
