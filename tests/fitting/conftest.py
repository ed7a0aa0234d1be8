from pathlib import Path

import pytest

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log
from quadjax.vehicle.vehicle_file import read_vehicle

REPOSITORY = Path(__file__).resolve().parents[2]
FLIGHTS = REPOSITORY.parent / "shared" / "flight_data"
RACING_INERTIA = {"i_xx": 0.0025, "i_yy": 0.0021, "i_zz": 0.0043}  # kg m^2


def refused(path: Path, form: str, *words: str) -> None:
    """Assert that a log is refused in one line with its path and some words."""
    with pytest.raises(InputError) as caught:
        read_log(path, LogsConfig(format=form))
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in (str(path), *words)), message


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
