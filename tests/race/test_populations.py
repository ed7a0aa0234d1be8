"""Published distributions of drones and their curriculum, against the printed fractions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.race import build_params
from quadjax.config.schema import Randomization
from quadjax.race.episode import interpolate
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.racing import A2RL
from tests.race.support import make_config

A2RL_RACE = ("vehicle=a2rl", "track=figure8_tudelft")
# Percent of: k_w; k_x, k_y; quadratic and aerodynamic; moments; J; w_min; w_max; k; tau.
PRINTED = {
    "monorace_fastest": (15, 20, 45, 45, 50, 20, 15, 45, 30),
    "monorace_robust": (50, 50, 50, 50, 50, 50, 40, 50, 55),
}
MOMENTS = [f"{name}{rotor}" for name in ("k_p", "k_q", "k_r", "k_rd") for rotor in (1, 2, 3, 4)]
GROUPS = (
    ("k_w",),
    ("k_x", "k_y"),
    ("k_x2", "k_y2", "k_angle", "k_hor"),
    MOMENTS,
    ("j_x", "j_y", "j_z"),
    ("w_min",),
    ("w_max",),
    ("k",),
    ("tau",),
)


@pytest.mark.parametrize("name", PRINTED)
def test_populations_of_the_a2rl_drone(name):
    config = make_config(*A2RL_RACE, f"randomization.population={name}")
    nominal = {key: np.float64(value) for key, value in config.vehicle.constants.items()}
    count, names = 4000, A2RL.constant_names
    drawn = np.random.default_rng(0).uniform(-1, 1, (count, len(names))).astype(np.float32)
    own = A2RL.make_constants({key: jnp.float32(value) for key, value in nominal.items()})
    found = jax.vmap(A2RL.populations[name], in_axes=(None, 0))(own, drawn)
    center = nominal | ({"tau": 0.025} if name == "monorace_robust" else {})
    table, spread = [], dict.fromkeys(names, 0.0)
    for group, percent in zip(GROUPS, PRINTED[name], strict=True):
        spread |= dict.fromkeys(group, percent / 100)
    for index, key in enumerate(names):
        values = np.broadcast_to(np.asarray(values_of(found)[key], np.float64), count)
        wanted = center[key] * (1 + spread[key] * drawn[:, index].astype(np.float64))
        np.testing.assert_allclose(values, wanted, rtol=1e-5)
        if spread[key] and center[key]:
            table.append(values / center[key])
    assert np.abs(np.corrcoef(table) - np.eye(len(table))).max() < 0.08  # each drawn alone


def test_the_width_scales_every_draw():
    half = make_config("randomization={all: 0.2, lag: 0.4, constants: {k_w: 0.1}, width: 0.5}")
    spread = build_params(half).randomization
    assert float(spread.k_w) == pytest.approx(0.05) and float(spread.tau) == pytest.approx(0.2)
    assert float(spread.k_x) == pytest.approx(0.1)
    one, other = ({"a": jnp.float32(x)} for x in (2.0, 6.0))
    for width, value in ((0.0, 2.0), (0.25, 3.0), (1.0, 6.0)):
        assert float(interpolate(one, other, width)["a"]) == value
    whole = make_config(*A2RL_RACE, "randomization.population=monorace_fastest")
    assert float(build_params(whole).population_width) == 1.0
    curriculum = make_config(
        *A2RL_RACE,
        "randomization.population=monorace_robust",
        "schedules.randomization.width={linear: [0, 1], until: 0.5}",
    )
    assert float(build_params(curriculum.at("randomization.width", 0.25)).population_width) == 0.25
    assert not Randomization(width=0.5).drawn and Randomization(lag=0.1).drawn
