"""What a fit may do to flights that it has not seen."""

from dataclasses import replace

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.fitting.config import load_fit_config
from quadjax.fitting.fit import fit
from quadjax.fitting.flight_log import write_log
from quadjax.fitting.report import tables, text_table
from quadjax.fitting.samples import ALL

from .conftest import REPOSITORY
from .flights import simulated

MOMENTS = ("Mx", "My", "Mz")
CONFIG = REPOSITORY / "configs/fit/paparazzi.yaml"


def test_a_table_has_no_colors_where_the_environment_forces_them(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a Jupyter kernel does
    assert (
        text_table("errors", ["axis", "RMSE"], [["az", "0.2"]]) == "errors\naxis  RMSE\naz     0.2"
    )


@pytest.fixture(scope="module")
def unlike(tmp_path_factory):
    """Four flights; of the last one the residual has the opposite sign."""
    folder = tmp_path_factory.mktemp("unlike")
    for seed in range(4):
        sign = -1.0 if seed == 3 else 1.0
        residual = (5, sign, (0.008 * sign, 0.008 * sign, 0.003 * sign))
        write_log(folder / f"flight_{seed}.csv", simulated(seed, residual))
    return folder


@pytest.fixture(scope="module")
def fitted(unlike):
    training = "residual={seeds: 2, epochs: 10}"
    return fit(load_fit_config(CONFIG, [f"logs.files=[{unlike}/*.csv]", training]), unlike)


@pytest.mark.slow
def test_the_written_residual_does_not_harm_any_flight_by_more_than_the_limit(fitted):
    """What fits the other flights harms the last one, so the written residual is scaled down."""
    for choice in fitted.residuals[ALL].choices.values():
        assert min(choice.gains) >= -0.1 - 1e-9
    for axis in MOMENTS:
        assert fitted.residuals[ALL].choices[axis].scale < 0.7
    assert "increases no fold's error by more than 10%" in tables(fitted)


@pytest.mark.slow
def test_a_held_out_flight_has_no_influence_on_the_choices_of_its_prediction(fitted):
    """The error of the unlike flight is reported as it is: the others do not show it."""
    held_out = {part.name: part.change for part in fitted.held_out}
    assert (held_out["flight_3"][3:] > 0.2).all()
    for axis in MOMENTS:
        assert fitted.residuals[frozenset({3})].choices[axis].scale > 0.9


@pytest.mark.slow
def test_a_test_flight_has_no_influence_on_the_fit(unlike, tmp_path):
    """Constants, residual and choices are those of a fit without the file."""
    training = "residual={seeds: 1, epochs: 2, mirror: 'off'}"
    for seed in range(3):
        name = f"flight_{seed}.csv"
        (tmp_path / name).write_bytes((unlike / name).read_bytes())
    tested, without = (
        fit(load_fit_config(CONFIG, [f"logs.files=[{folder}/*.csv]", training, *more]), folder)
        for folder, more in ((unlike, ["split.test_flights=[flight_3]"]), (tmp_path, []))
    )
    assert [part.name for part in tested.held_out][3:] == ["flight_3"]
    assert replace(tested.vehicle, path=without.vehicle.path) == without.vehicle
    choices, others = (result.residuals[ALL].choices for result in (tested, without))
    for axis, choice in choices.items():
        np.testing.assert_allclose(choice.gains, others[axis].gains, rtol=1e-5, err_msg=axis)


RACING = "vehicle=5inch.yaml"


@pytest.mark.parametrize(
    ("key", "value", "others"),
    [
        ("split.test_fraction", 0.4, []),
        ("nominal.axes", "[az]", ["nominal.fit=false"]),
        ("residual.seeds", 2, ["residual.fit=false"]),
        ("seed", 1, ["residual.fit=false"]),
        ("residual.max_harm", 0.2, [RACING]),
        ("body.inertia", "base", [RACING]),
        ("split.folds", 3, [RACING, "split.by=time"]),
    ],
)
def test_keys_without_effect_are_refused(key, value, others, unlike):
    files = f"logs.files=[{unlike}/flight_0.csv, {unlike}/flight_1.csv]"
    body = ["body.inertia=null", "body.rpm_range=null"] if RACING in others else []
    arguments = [files, *body, f"{key}={value}", *others]
    with pytest.raises(InputError, match=rf"^{key} is .*, which has no effect: .*; allowed: "):
        fit(load_fit_config(CONFIG, arguments), unlike)
