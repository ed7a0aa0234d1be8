from pathlib import Path

import pytest

from quadjax.fitting.vehicle_file import read_vehicle

REPOSITORY = Path(__file__).resolve().parents[2]
FLIGHTS = REPOSITORY.parent / "shared" / "flight_data"


@pytest.fixture(scope="session")
def bebop():
    return read_vehicle("bebop1.yaml").motor


@pytest.fixture(scope="session")
def real_flights():
    """Paths of four real flights, which are no part of the project."""
    paths = sorted(FLIGHTS.glob("*.csv"))
    if len(paths) < 4:
        pytest.skip("no real flights in ../shared/flight_data beside the repository")
    return paths
