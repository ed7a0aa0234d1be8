import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.policy import pilot
from quadjax.policy.inference import mean_action
from quadjax.race import episode
from quadjax.race.layout import LAST_ACTION, Layout
from quadjax.race.observation_config import Observation
from quadjax.training.build import initial_policy
from tests.evaluation.support import random_policy
from tests.race.support import BLANK

WIDE = {"command_low": np.full(4, 2000.0), "command_high": np.full(4, 12000.0)}


def make(policy, *overrides: str):
    config = load_config(BLANK, overrides)
    environment, params = pilot.adapt_race(*make_race(config), policy)
    return environment, params, pilot.make_pilot(policy, deterministic=True)


def test_equal_ranges_change_no_bit():
    environment, params, _ = make(random_policy())
    state = episode.hover_start(environment, params)
    own, action = params.replace(ranges=None), jnp.array([-1.0, -0.3, 0.2, 1.0])
    seen = [np.asarray(environment.observation(x, state)) for x in (params, own)]
    np.testing.assert_array_equal(*seen)
    sent = [jax.tree.leaves(environment.command(x, action)) for x in (params, own)]
    np.testing.assert_array_equal(*sent)


def test_the_policy_commands_what_its_file_says():
    policy = random_policy(**WIDE)
    environment, params, ready = make(policy, "vehicle.constants.rpm_max=11500.0")
    random = np.random.default_rng(1)
    noise = jnp.zeros(4)
    for _ in range(5):
        rpm = random.uniform(3000, 11500, 4)
        seen = random.normal(size=24)
        seen[20:] = 0.0
        state = episode.hover_start(environment, params)
        drone = state.drone.replace(actuators=Rotors(*jnp.asarray(rpm, jnp.float32)))
        shown = environment.observation(params, state.replace(drone=drone))[12:16]
        np.testing.assert_allclose(shown, 2 * (rpm - 2000) / 10000 - 1, atol=1e-6)
        action = pilot.act(ready, jnp.asarray(seen, jnp.float32), noise)
        given = jax.tree.leaves(environment.command(params, action))
        mean = np.clip(mean_action(policy.on_device(), jnp.asarray(seen, jnp.float32)), -1, 1)
        wanted = np.clip(2000 + 5000 * (np.asarray(mean) + 1), 3000, 11500)
        np.testing.assert_allclose(given, wanted, atol=0.5)


def test_a_file_without_ranges_observes_in_that_of_its_commands():
    """As its exported C does: rotor speeds and the last action, in other limits than the race's."""
    policy = random_policy(**WIDE, observed=Observation(last_action=True))
    fields = (dataclasses.replace(field, span=None) for field in policy.layout.fields)
    policy = dataclasses.replace(policy, layout=Layout(tuple(fields)))
    environment, params, _ = make(policy, "observation.last_action=true")
    state = episode.hover_start(environment, params)
    drone = state.drone.replace(actuators=Rotors.same(jnp.float32(4500.0)))
    memories = {LAST_ACTION: (jnp.float32(0.25),) * 4}
    seen = environment.observation(params, state.replace(drone=drone, memories=memories))
    np.testing.assert_allclose(seen[environment.layout.slice("rpm")], -0.5, atol=1e-6)
    np.testing.assert_allclose(seen[environment.layout.slice(LAST_ACTION)], 0.25, atol=1e-6)


def test_disturbances_are_seen_in_the_policys_scale():
    """Also where the race draws none, and meets a steady moment all the same."""
    widths = {"moment_x": 0.02, "moment_y": 0.02, "moment_z": 0.0, "force_z": 1.0}
    policy = random_policy(widths=widths)
    for overrides in ([], ["disturbance.moment_x=0.04", "disturbance.moment_z=0.01"]):
        environment, params, _ = make(policy, *overrides)
        state = episode.hover_start(environment, params)
        moment = Vec3.of(jnp.array([0.04, -0.01, 0.005]))
        met = state.drone.replace(moment_ext=moment, force_ext=moment.replace(z=jnp.array(-0.5)))
        observed = environment.observation(params, state.replace(drone=met))
        np.testing.assert_allclose(observed[20:], [2.0, -0.5, 0.0, -0.5], rtol=1e-6)
    _, params, _ = make(random_policy(), "disturbance.moment_x=0.04")  # a policy without widths
    low, high = params.ranges.observed
    assert float(high[20]) == np.float32(0.04) == -float(low[20]) and float(high[23]) == 0.0


def test_the_observation_is_made_as_the_policy_was_trained():
    observed = Observation(wrap_next_yaw=False, disturbance="none")
    environment, params, _ = make(random_policy(observed=observed))
    # The source of the disturbance is the race's choice: it is what a drone can measure.
    assert environment.layout["moment_ext"].source == "ground_truth"
    state = episode.hover_start(environment, params).replace(target=jnp.int32(3))
    shown = environment.observation(params, state)[environment.layout.slice("next_yaw_unwrapped")]
    assert float(shown[0]) == pytest.approx(-1.5 * np.pi)


def test_samples_are_about_the_mean():
    policy = random_policy()
    _, _, ready = make(policy)
    seen, noise = jnp.full(24, 0.1), jnp.full(4, 0.1)
    mean = pilot.act(ready, seen, noise)
    sampled = pilot.act(ready.replace(noise=jnp.float32(1.0)), seen, noise)
    np.testing.assert_allclose(sampled, mean + 0.1 * np.exp(-1.0), atol=1e-6)


def test_what_does_not_fit_is_refused():
    policy = random_policy()
    own = dataclasses.replace(policy.layout.fields[0], name="altitude")
    other = dataclasses.replace(policy, layout=Layout((own, *policy.layout.fields[1:])))
    for unfit, says in (
        (random_policy("rate"), r"file.npz: a policy for vehicle.model=rate"),
        (other, r"observes 'altitude' \(3\), which the race"),
    ):
        with pytest.raises(InputError, match=says):
            pilot.adapt_race(*make_race(load_config(BLANK)), unfit, "file.npz")


def test_a_policy_of_an_own_model_starts_a_run(tmp_path):
    """A file has the model's name, a config the place of the model."""
    path = tmp_path / "policy.npz"
    policy = random_policy("rate")
    policy.save(path)
    overrides = ["network.hidden=[8]", "network.activation=relu", f"run.initial_policy={path}"]
    config = load_config(BLANK, [*overrides, "vehicle.model=tests.config.models:NO_RATIO"])
    assert initial_policy(config).vehicle == "rate"
    with pytest.raises(InputError, match="has vehicle rate, the config has motor"):
        initial_policy(load_config(BLANK, overrides))


def test_a_policy_with_its_fields_in_another_order_flies_the_same():
    """A layout is what a policy says, not where its numbers happen to be."""
    policy = random_policy(command_high=np.full(4, 12000.0))
    environment, params, ready = make(policy)
    order = np.roll(np.arange(len(policy.layout.fields)), 3)
    fields = [policy.layout.fields[i] for i in order]
    columns = np.concatenate([np.arange(24)[policy.layout.slice(f.name)] for f in fields])
    kernel, bias = policy.layers[0]
    turned = dataclasses.replace(
        policy, layout=Layout(tuple(fields)), layers=((kernel[columns], bias), *policy.layers[1:])
    )
    other, other_params, other_ready = make(turned)
    state = episode.hover_start(environment, params)
    first = pilot.act(ready, environment.observation(params, state), jnp.zeros(4))
    shown = other.observation(other_params, state)
    np.testing.assert_allclose(pilot.act(other_ready, shown, jnp.zeros(4)), first, atol=1e-6)
