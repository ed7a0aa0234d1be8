"""Numbers in units of the race."""

import math

import pytest

from quadjax.config.loading import load_config
from quadjax.config.scales import race_scales
from quadjax.core.errors import InputError
from quadjax.training.build import input_scale

NO_RATIO = "vehicle.model=tests.config.models:NO_RATIO"


def scales_of(config):
    return race_scales(config.track, config.vehicle, config.rules.time_step)


def test_units_of_the_papers_race():
    """Legs of 4 and 3 m; four rotors of k_w rpm_max^2 each, against g."""
    scales = scales_of(load_config("e2e_fastest"))
    thrust = 4 * 4.36301076e-08 * 11000**2
    assert scales.leg == pytest.approx(3.5)
    assert scales.acceleration == pytest.approx(math.sqrt(thrust**2 - 9.81**2), rel=1e-6)
    assert scales.half_gate == 0.5
    assert scales.time == pytest.approx(math.sqrt(3.5 / scales.acceleration))


def test_numbers_with_a_unit_become_plain_numbers():
    config = load_config(
        "e2e_fastest",
        [
            "track=figure8_tudelft",
            "reward.progress=10 per leg",
            "training_limits.gate_inflation=0.6 half gates",
            "training_limits.yaw_rate=2.5 per leg time",
            "start.velocity=0.1 legs per leg time",
            "start.position=.2 legs",
            "training_limits.episode_steps=28 leg times",
            "learner.horizon=1.5 leg times",
            "learner.discount=2 leg times",
            "learner.cotangent_decay=1 leg times",
            "schedules.learner.cotangent_decay={linear: [1 leg times, 2e0 leg times]}",
        ],
    )
    scales = scales_of(config)
    leg, time = scales.leg, scales.time
    assert leg == pytest.approx(1.5 * math.sqrt(2))
    assert config.reward.progress == pytest.approx(10 / leg)
    assert config.training_limits.gate_inflation == pytest.approx(0.45)
    assert config.training_limits.yaw_rate == pytest.approx(2.5 / time)
    assert config.start.velocity == pytest.approx(0.1 * leg / time)
    assert config.start.position == pytest.approx(0.2 * leg)
    assert config.training_limits.episode_steps == round(28 * time / 0.01)
    assert config.learner.horizon == round(1.5 * time / 0.01)
    assert config.learner.discount == pytest.approx(math.exp(-0.01 / (2 * time)))
    decays = config.schedules["learner.cotangent_decay"].linear
    assert decays == pytest.approx([math.exp(-0.01 / time), math.exp(-0.005 / time)])


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("learner.horizon=2 legs", "learner.horizon is 2 legs, allowed: a number of leg times"),
        ("learner.discount=-1 leg times", "learner.discount is -1 leg times"),
        ("reward.gate=2 feet", "reward.gate is"),
    ],
)
def test_a_wrong_unit_is_one_line(override, named):
    with pytest.raises(InputError, match=named) as caught:
        load_config("e2e_fastest", [override])
    assert "\n" not in str(caught.value)


def test_a_model_without_thrust_to_weight_has_no_units():
    with pytest.raises(InputError, match="has no thrust_to_weight"):
        load_config("e2e_fastest", [NO_RATIO, "reward.progress=10 per leg"])


def test_a_race_scaled_in_length_and_time_has_the_same_numbers(tmp_path):
    """Twice the lengths and half the acceleration is half as fast: all numbers scale with it."""
    keys = [
        "network.normalize=true",
        "reward.progress=10 per leg",
        "learner.horizon=1.1 leg times",
        "learner.discount=2.3 leg times",
        "rules.position_limit=null",
    ]
    track = tmp_path / "large.yaml"
    corners = [(4, -3, 45), (4, 3, 135), (-4, 3, 225), (-4, -3, 315)]
    gates = [f"  - {{position: [{x}, {y}, -3], yaw_deg: {a}, size: [2, 2]}}" for x, y, a in corners]
    track.write_text("gates:\n" + "\n".join(gates) + "\n")
    small = load_config("e2e_fastest", keys)
    own = load_config("e2e_fastest", [*keys, f"track={track}", "rules.time_step=0.01414213562"])
    for key in ("horizon", "discount", "cotangent_decay"):
        found, wanted = getattr(own.learner, key), getattr(small.learner, key)
        assert found == pytest.approx(wanted, abs=1e-9)
    assert own.reward.progress == pytest.approx(small.reward.progress / 2)
    factors = [b / a for a, b in zip(input_scale(small), input_scale(own), strict=True)]
    length, velocity, rate = 0.5, 1 / math.sqrt(2), math.sqrt(2)
    assert factors[:12] == pytest.approx([length] * 3 + [velocity] * 3 + [1] * 3 + [rate] * 3)
