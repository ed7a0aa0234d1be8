import os
from pathlib import Path

import numpy as np
import pytest

from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log, write_log
from quadjax.fitting.formats import PLAIN
from quadjax.vehicle.vehicle_file import read_vehicle

from .flights import write_flights

REPOSITORY = Path(__file__).resolve().parents[2]
FLIGHTS = REPOSITORY.parent / "shared" / "flight_data"
RACING_INERTIA = {"i_xx": 0.0025, "i_yy": 0.0021, "i_zz": 0.0043}  # kg m^2


@pytest.fixture(scope="session")
def bebop():
    return read_vehicle("bebop1.yaml").motor


def _simulated(folder):
    """Four flights of a heavier drone with a residual, in the plain columns of the real ones."""
    motor = read_vehicle("bebop1.yaml").motor
    factors = {name: value / getattr(motor, name) for name, value in RACING_INERTIA.items()}
    source = folder / "paparazzi"
    source.mkdir()
    for path in write_flights(source, 4, residual=(5, 0.7, (0.02, 0.02, 0.006)), **factors):
        log = read_log(path, LogsConfig(format="paparazzi"))
        values = (log.time, log.rpm, log.rates, log.specific_force, log.body_velocity)
        quantities = ("time", "rpm", "gyro", "acceleration", "body_velocity")
        columns = {
            name: column
            for quantity, value in zip(quantities, values, strict=True)
            for name, column in zip(PLAIN[quantity], np.atleast_2d(value.T), strict=True)
        }
        write_log(folder / path.name, columns)
    return sorted(folder.glob("*.csv"))


def _real():
    """Logs of four flights beside the repository, which are no part of it; empty without them."""
    paths = sorted(FLIGHTS.glob("*.csv"))
    return paths if len(paths) >= 4 and "SIMULATED_FLIGHTS" not in os.environ else []


@pytest.fixture(scope="session", params=["real flights" if _real() else "simulated flights"])
def plain_flights(tmp_path_factory):
    """Logs of four flights; the ids of tests and the summary say whether they are real.

    Set ``SIMULATED_FLIGHTS`` in the environment to use simulated ones in any case.
    """
    return _real() or _simulated(tmp_path_factory.mktemp("flights"))
