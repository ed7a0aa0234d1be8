"""States of a best known lap as starts of training."""

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.files import write_npz
from quadjax.race.recorded_starts import read_states

pytest.importorskip("casadi")


def _file(path, **changes):
    from quadjax.limits.report import LIMIT

    rng = np.random.default_rng(0)
    arrays = {name: rng.normal(size=(9, 3)) for name in ("position", "velocity", "rates")}
    arrays |= {"euler": np.full((9, 3), 4.0), "actuators": np.full((9, 4), 5000.0)}
    arrays |= {"leg_times": np.ones(4)} | changes
    write_npz(path, arrays, {"format": LIMIT, "track": [{}] * 4})
    return arrays


def test_each_node_has_the_gate_ahead_as_its_target(tmp_path):
    from quadjax.limits.report import read_starts

    lap, starts = tmp_path / "lap.npz", tmp_path / "starts.npz"
    arrays = _file(lap)
    read_starts(str(lap)).save(starts)
    states = read_states(starts).arrays
    assert states["target"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    np.testing.assert_array_equal(states["position"], arrays["position"][:-1])
    np.testing.assert_allclose(states["euler"], 4.0 - 2.0 * np.pi)
    np.testing.assert_array_equal(states["actuators"], arrays["actuators"][:-1])


def test_a_file_without_the_actuators_is_refused(tmp_path):
    from quadjax.limits.report import LIMIT, read_starts

    write_npz(tmp_path / "lap.npz", {"position": np.zeros((9, 3))}, {"format": LIMIT})
    with pytest.raises(InputError, match="velocity is missing; expected a file of quadjax limit"):
        read_starts(str(tmp_path / "lap.npz"))
