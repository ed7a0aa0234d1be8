"""States of a best known lap as starts of training."""

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.files import write_npz
from quadjax.race.recorded_starts import LIMIT, read_states


def test_each_node_has_the_gate_ahead_as_its_target(tmp_path):
    rng, lap = np.random.default_rng(0), tmp_path / "lap.npz"
    arrays = {name: rng.normal(size=(9, 3)) for name in ("position", "velocity", "rates")}
    arrays |= {"euler": np.full((9, 3), 4.0), "actuators": np.full((9, 4), 5000.0)}
    arrays |= {"leg_times": np.ones(4)}
    write_npz(lap, arrays, {"format": LIMIT, "track": [{}] * 4})
    states = read_states(lap).arrays
    assert states["target"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    np.testing.assert_array_equal(states["position"], arrays["position"][:-1])
    np.testing.assert_allclose(states["euler"], 4.0 - 2.0 * np.pi)
    np.testing.assert_array_equal(states["actuators"], arrays["actuators"][:-1])


def test_a_flight_without_the_actuators_is_refused(tmp_path):
    write_npz(tmp_path / "lap.npz", {"position": np.zeros((9, 3))}, {"format": LIMIT})
    with pytest.raises(InputError, match="velocity is missing"):
        read_states(tmp_path / "lap.npz")
