"""Vehicle files as base and result of a fit."""

import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.fitting.config import BodyConfig, with_body
from quadjax.vehicle.vehicle_file import read_vehicle, write_vehicle

from .conftest import REPOSITORY

BEBOP = (REPOSITORY / "configs/vehicles/bebop1.yaml").read_text()
RACING = (REPOSITORY / "configs/vehicles/5inch.yaml").read_text()


def _written(base, inertia, folder):
    path = folder / "mine.yaml"
    write_vehicle(path, with_body(base, BodyConfig(inertia=inertia)), "a fit")
    return path


def test_width_and_speed_of_the_same_drone_are_kept(tmp_path):
    """So that a training on it still refuses gates that the drone does not fit through."""
    (tmp_path / "base.yaml").write_text(f"fitted_speed: 7.5\n{BEBOP}")
    base = read_vehicle("base.yaml", tmp_path)
    path = _written(base, "base", tmp_path)
    vehicle = load_config("e2e", [f"vehicle={path}"]).vehicle
    assert (vehicle.width, vehicle.fitted_speed) == (0.32, 7.5)
    other = load_config("e2e", [f"vehicle={_written(base, [1e-3, 1e-3, 2e-3], tmp_path)}"])
    assert other.vehicle.width == 0.0  # of another drone it is not known


def test_a_file_with_two_models_and_lists_of_rotors_is_read_and_written(tmp_path):
    """The lists are in the order of the file's key ``rotors``."""
    lines = [line for line in RACING.splitlines() if not line.startswith(("name:", "model:"))]
    (tmp_path / "both.yaml").write_text("\n".join([BEBOP, "model: motor", *lines]))
    base = read_vehicle("both.yaml", tmp_path)
    path = _written(base, "base", tmp_path)
    assert read_vehicle(str(path)) == with_body(base, BodyConfig(inertia="base"))
    text = path.read_text().replace("model: motor", "model: racing")
    path.write_text(text)
    assert read_vehicle(str(path)).racing == read_vehicle("5inch.yaml").racing
    expected = load_config("e2e +fastest", ["vehicle=5inch.yaml"]).vehicle.constants
    assert load_config("e2e +fastest", [f"vehicle={path}"]).vehicle.constants == expected


@pytest.mark.parametrize("line", ["width: wide", "fitted_speed: .nan", "mass: [1]"])
def test_values_that_are_no_numbers_are_named(line, tmp_path):
    key = line.partition(":")[0]
    others = [each for each in BEBOP.splitlines() if not each.startswith(f"{key}:")]
    (tmp_path / "base.yaml").write_text("\n".join([line, *others]))
    with pytest.raises(InputError, match=f"{key} is .*, expected a finite number"):
        read_vehicle("base.yaml", tmp_path)
