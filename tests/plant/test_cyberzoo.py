"""The plant ``cyberzoo``: its drones, and what follows from the commands of real policies.

``tests/policy/test_c_networks.py`` flies these policies on it.
"""

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.plant.config import PlantConfig, load_plant_config
from tests.plant.cyberzoo_trace import FILE, NAMES, answered

SCALES = np.repeat([1.0, 1.0, 1.0, 1000.0], [3, 3, 3, 4])  # m, m/s, rad/s, rpm


@pytest.mark.slow  # compiles the plant
@pytest.mark.parametrize("name", NAMES)
def test_commands_of_the_published_networks_have_the_stored_answer(name):
    """Physics, inner loop and population: one second of four drones, open loop."""
    stored = np.load(FILE)
    found = answered(name, stored[name])
    np.testing.assert_allclose(found / SCALES, stored[f"{name}_state"] / SCALES, atol=0.02)
    # The drones differ, and none is where it began.
    assert np.ptp(found[:, 0]) > 0.005 and np.all(np.linalg.norm(found[:, 3:6], axis=1) > 1.0)


def test_it_has_at_least_twenty_drones():
    plant = load_plant_config("cyberzoo")
    counts = {len(values) for values in plant.population.values()}
    assert counts == {20}
    drones = [plant.member(number) for number in range(20)]
    assert all(drone != other for drone in drones for other in drones if other is not drone)


@pytest.mark.parametrize(
    "words", ["vehicle: mine.yaml", "name: mine\nvehicle: bebop1_authors.yaml"]
)
def test_its_drones_are_of_no_other_vehicle(words, tmp_path):
    path = tmp_path / "own.yaml"
    message = "fitted to bebop1.yaml; for another drone use base: plant/standin"
    path.write_text(f"base: plant/cyberzoo\n{words}\n")
    with pytest.raises(InputError, match=f"/own.yaml: vehicle is '.*.yaml', but .* are {message}$"):
        load_plant_config(path)
    with pytest.raises(InputError, match=f"overrides: .*{message} "):
        load_plant_config("cyberzoo", ["vehicle=mine.yaml"])


def test_a_vehicle_may_have_its_own_population(tmp_path):
    population = "population: {motors.tau: [0.02, 0.03]}\nairframe: {force_z: {w: 0.1}}\n"
    for own in ("", "fitted_vehicle: mine\n"):
        path = tmp_path / "own.yaml"
        path.write_text(f"base: plant/standin\nvehicle: mine.yaml\n{population}{own}")
        assert load_plant_config(path).member(1).motors.tau == 0.03
    path.write_text("base: plant/cyberzoo\nvehicle: bebop1\n")
    assert load_plant_config(path).population == load_plant_config("cyberzoo").population
    assert PlantConfig(vehicle="mine.yaml").fitted_vehicle is None
