"""The table of best known laps."""

import threading

import numpy as np
import pytest

from quadjax.core.files import write_npz

pytest.importorskip("casadi")


@pytest.mark.slow
def test_an_interrupted_pair_starts_from_the_flight_that_was_found(tmp_path, monkeypatch):
    from quadjax.limits import run
    from quadjax.limits.solve import NotFoundError
    from quadjax.race.recorded_starts import LIMIT
    from quadjax.studies import limits_table

    tried = {}

    def search(problem, given, **options):
        tried.update(given)
        raise NotFoundError("none")

    monkeypatch.setattr(run, "search", search)
    flight = {"leg_times": np.ones(4), "state": np.ones((9, 17)), "command": np.ones((9, 4))}
    path = limits_table.file_of(tmp_path, "square4", "A2RL")
    write_npz(path.with_suffix(".npz"), flight, {"format": LIMIT})
    stop, drones = threading.Event(), ["A2RL", "3-inch"]
    limits_table.make(tmp_path, ["square4"], drones, 1.0, None, stop, lambda text: None)
    assert list(tried) == ["earlier flight"]
    assert tried["earlier flight"].total == 4.0
    assert "square4, 3-inch" in limits_table.markdown(tmp_path, ["square4"])


@pytest.mark.slow
def test_a_guess_after_a_simulation():
    from quadjax.config.loading import load_config
    from quadjax.config.race import race_of
    from quadjax.limits.guess import from_point_mass
    from quadjax.limits.problem import make_problem
    from quadjax.limits.simulation import simulate

    choices, params = race_of(load_config("e2e_fastest", ["vehicle=a2rl"]))
    problem = make_problem(choices.model, params)
    simulate(problem, np.full((5, 4), 0.3), 1e-3)
    assert np.isfinite(from_point_mass(problem, 4, 4.0).states).all()
