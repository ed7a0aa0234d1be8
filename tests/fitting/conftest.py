from pathlib import Path

import pytest

from quadjax.vehicle.vehicle_file import read_vehicle

REPOSITORY = Path(__file__).resolve().parents[2]
FLIGHTS = REPOSITORY.parent / "shared" / "flight_data"
RACING_INERTIA = {"i_xx": 0.0025, "i_yy": 0.0021, "i_zz": 0.0043}  # kg m^2


@pytest.fixture(scope="session")
def bebop():
    return read_vehicle("bebop1.yaml").motor


@pytest.fixture(scope="session")
def plain_flights():
    """Logs of four flights beside the repository, which are no part of it."""
    paths = sorted(FLIGHTS.glob("*.csv"))
    if len(paths) < 4:
        pytest.skip("no logs of real flights beside the repository")
    return paths
