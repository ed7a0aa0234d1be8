"""Numbers in units of the race."""

import functools
import math

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.reference import commented_yaml
from quadjax.config.scales import race_scales
from quadjax.core.errors import InputError
from quadjax.training.build import make_training

NO_RATIO = "vehicle.model=tests.config.models:NO_RATIO"


def scales_of(config):
    return race_scales(config.track, config.vehicle, config.rules.time_step)


def test_numbers_with_a_unit_become_plain_numbers():
    config = load_config(
        "e2e +fastest",
        [
            "track=figure8_tudelft",
            "reward.progress=10 per leg",
            "training_limits.gate_inflation=0.6 half gates",
            "reward.gate_edge=30 per half gate",
            "training_limits.yaw_rate=2.5 per leg time",
            "start.velocity=0.1 legs per leg time",
            "start.position=.2 legs",
            "training_limits.episode_steps=28 leg times",
            "learner.horizon=1.5 leg times",
            "learner.num_envs=20 per leg time",
            "learner.discount=2 leg times",
            "learner.cotangent_decay=1 leg times",
            "learner.cotangent_clip=3 per leg per leg time",
            "schedules.learner.cotangent_decay={linear: [1 leg times, 2e0 leg times]}",
        ],
    )
    scales = scales_of(config)
    leg, time = scales.leg, scales.time
    thrust = 4 * 4.36301076e-08 * 11000**2  # of four rotors, k_w rpm_max^2 each
    assert time == pytest.approx(math.sqrt(leg / math.sqrt(thrust**2 - 9.81**2)), rel=1e-6)
    assert scales.half_gate == 0.75
    assert leg == pytest.approx(1.5 * math.sqrt(2))
    assert config.reward.progress == pytest.approx(10 / leg)
    assert config.training_limits.gate_inflation == pytest.approx(0.45)
    assert config.reward.gate_edge == pytest.approx(40.0)
    assert config.training_limits.yaw_rate == pytest.approx(2.5 / time)
    assert config.start.velocity == pytest.approx(0.1 * leg / time)
    assert config.start.position == pytest.approx(0.2 * leg)
    assert config.training_limits.episode_steps == round(28 * time / 0.01)
    assert config.learner.horizon == round(1.5 * time / 0.01)
    assert config.learner.num_envs == 8 * round(20 / time / 8)
    assert config.learner.discount == pytest.approx(math.exp(-0.01 / (2 * time)))
    assert config.learner.cotangent_clip == pytest.approx(3 / (leg * time))
    decays = config.schedules["learner.cotangent_decay"].linear
    assert decays == pytest.approx([math.exp(-0.01 / time), math.exp(-0.005 / time)])


def test_a_saved_config_has_plain_numbers(tmp_path):
    """They stay what they are on another track."""
    saved, over = tmp_path / "config.yaml", ["track=split_s", "rules.position_limit=null"]
    first = load_config("e2e_race", ["learner.std=0.2"])
    saved.write_text(first.to_yaml())
    assert load_config(saved) == first
    assert load_config(saved, over).reward == first.reward
    assert load_config("e2e_race", over).reward.progress < 0.5 * first.reward.progress


def test_a_printed_preset_keeps_its_units(tmp_path):
    """On another track its numbers are those of the preset there."""
    units, mine = {}, tmp_path / "mine.yaml"
    config = load_config("e2e_race", ["seed=3"], units_written=units)
    mine.write_text(commented_yaml(config, units))
    over = ["track=split_s", "rules.position_limit=null"]
    assert load_config(mine) == config
    assert load_config(mine, over) == load_config("e2e_race", ["seed=3", *over])
    text = " ".join(line.strip(" #") for line in mine.read_text().splitlines())
    assert f"13.5 per leg: {config.reward.progress:g}" in text
    assert f"5 leg times: {config.schedules['learner.discount'].linear[1]:g}" in text


def test_a_lap_of_one_gate_has_no_units():
    """Nor is it a lap; on a course, the leg of the only gate is the way from the start."""
    gate = "track.gates=[{position: [6, 0, -2]}]"
    for preset in ("e2e_race", "e2e"):
        with pytest.raises(InputError, match="track.gates is '1 gate', allowed: two gates or more"):
            load_config(preset, [gate])
    course = [gate, "track.closed=false", "evaluate.laps=1", "start.position=0.1 legs"]
    found = load_config("e2e", [*course, "track.start={position: [1, 0, -2]}"])
    assert found.start.position == pytest.approx(0.5)


def test_a_model_without_thrust_to_weight_has_no_units():
    with pytest.raises(InputError, match="a model that has thrust_to_weight"):
        load_config("e2e +fastest", [NO_RATIO, "reward.progress=10 per leg"])


KEYS = (
    "vehicle.model=rate",
    "network.normalize=true",
    "rules.position_limit=null",
    "start.gate=random",
    "start.along_leg=1",
    "start.position=0.9 half gates",
    "start.velocity=0.06 legs per leg time",
    "start.body_rates=0.4 per leg time",
    "reward.progress=10 per leg",
    "reward.next_gate_progress=10 per leg",
    "reward.gate_edge=300 per leg",
    "reward.gate_edge_margin=0.1 half gates",
    "reward.gate_edge_reach=0.3 legs",
    "training_limits.gate_inflation=0.5 half gates",
    "training_limits.yaw_rate=2 per leg time",
    "training_limits.episode_steps=3 leg times",
    "learner.horizon=1.1 leg times",
    "learner.discount=2.3 leg times",
    "learner.cotangent_decay=1.1 leg times",
)
SLOWER = (  # twice the time: half of every rate, twice every lag; accelerations are the same
    "rules.time_step=0.02",
    "vehicle.constants.d_x=0.17",
    "vehicle.constants.d_y=0.215",
    "vehicle.constants.tau_rate=0.06",
    "vehicle.constants.tau_thrust=0.06",
    "vehicle.constants.p_max=1.5",
    "vehicle.constants.q_max=1.5",
    "vehicle.constants.r_max=1.5",
)


def flight(config):
    """What a learner gets of 16 flights with random commands: inputs, rewards and ends."""
    task = make_training(config)[0].task
    environment, params = task.environments.one, task.env_params
    keys = jax.random.split(jax.random.key(0), 16)
    actions = jax.random.uniform(jax.random.key(1), (180, 16, 4), minval=-1.0, maxval=1.0)
    over_drones = functools.partial(jax.vmap, in_axes=(None, 0))

    def step(state, action):
        seen = over_drones(environment.observe)(params, state)
        step = jax.vmap(environment.step, in_axes=(None, 0, 0))
        state, reward, terminated, truncated = step(params, state, action)
        return state, (seen, reward, terminated, truncated)

    start = over_drones(environment.reset)(params, keys)
    seen, *others = jax.jit(lambda: jax.lax.scan(step, start, actions)[1])()
    return [np.asarray(x) for x in (seen, *others)]


@pytest.mark.slow
def test_a_race_scaled_in_length_and_time_trains_alike(tmp_path):
    """Four times the lengths and twice the times: a learner gets the same numbers."""
    places = ((8, -6, 45), (8, 6, 135), (-8, 6, 225), (-8, -6, 315))
    gates = [f"{{position: [{x}, {y}, -6], yaw_deg: {a}, size: [4, 4]}}" for x, y, a in places]
    (tmp_path / "large.yaml").write_text("gates:\n  - " + "\n  - ".join(gates) + "\n")
    small = load_config("indi +fastest", KEYS)
    large = load_config("indi +fastest", [*KEYS, *SLOWER, f"track={tmp_path / 'large.yaml'}"])
    assert large.learner == small.learner
    assert large.training_limits.episode_steps == small.training_limits.episode_steps
    assert large.reward.progress == small.reward.progress / 4
    one, other = flight(small), flight(large)
    assert one[2].any() and one[3].any()
    for first, second in zip(one, other, strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-4)
