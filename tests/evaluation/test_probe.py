"""Linear probes, and drones that are drawn from a randomization."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.studies.drawn_drones import draw_drones, quantities, reachable
from quadjax.studies.probe import Samples, fit_probes, probe_table
from quadjax.training.build import untrained_policy
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.registry import model
from tests.race.support import BLANK
from tests.scripts import run_script

DRONES, EACH = 1200, 3


def known_samples():
    random = np.random.default_rng(0)
    drone = np.repeat(np.arange(DRONES), EACH)
    ratio, lag = random.normal(2.0, 0.3, DRONES), random.normal(0.05, 0.01, DRONES)
    seen = ratio[drone]
    noise = random.normal(0.0, 0.3, (5, len(drone)))
    inputs = {
        "exact": np.stack([7.0 - 100.0 * seen, noise[0], np.ones_like(seen)], 1),
        "noisy": np.stack([seen + noise[1] / np.sqrt(3.0), noise[2]], 1),
        "blind": noise[3:].T,
        "identity": np.eye(DRONES)[drone],
    }
    return Samples(drone, inputs, {"thrust to weight": ratio, "tau": lag})


def test_probes_of_known_inputs_have_the_known_r_squared():
    found = fit_probes(known_samples(), "mine")
    scores = {source: row["thrust to weight"] for source, row in found.r_squared.items()}
    assert (found.fitted, found.held_out) == (600, 600)
    assert scores["exact"] > 0.9999
    assert scores["noisy"] == pytest.approx(0.75, abs=0.03)  # noise of a third of the variance
    assert abs(scores["blind"]) < 0.02
    assert scores["identity"] < 0.02  # it tells the fitted drones only
    assert all(abs(row["tau"]) < 0.02 for row in found.r_squared.values())
    assert probe_table([found]).splitlines()[2] == "| mine | exact | 1.00 | -0.01 |"


def test_limits_of_the_commands_are_within_the_nominal_range():
    motor, racing = (load_config(BLANK, own) for own in ([], ["vehicle=5inch"]))
    drawn = {}
    for config in (motor, racing):
        own = model(config.vehicle.model)
        nominal = own.make_constants(config.vehicle.constants)
        factors = jnp.array([0.9, 1.2])
        wide = own.make_constants({k: x * factors for k, x in values_of(nominal).items()})
        drawn[own.name] = reachable(own, nominal, wide), nominal
    found, nominal = drawn["motor"]
    np.testing.assert_allclose(found.rpm_max, nominal.rpm_max * np.array([0.9, 1.0]))
    np.testing.assert_allclose(found.rpm_min, nominal.rpm_min * np.array([1.0, 1.2]))
    found, nominal = drawn["racing"]
    np.testing.assert_allclose(found.w_max, nominal.w_max * np.array([0.9, 1.2]), rtol=1e-6)
    ratio = quantities(model("racing"), found)["thrust to weight"]
    # Thrust coefficient and square of the speed have the factor; so has gravity.
    np.testing.assert_allclose(ratio, 10.98 * np.array([0.9, 1.2]) ** 2, rtol=0.01)


@pytest.mark.slow
def test_drawn_drones_are_vehicle_files(tmp_path, capsys):
    draw = ["--count", "2", "--seed", "3", "--output", str(tmp_path)]
    (tmp_path / "file").touch()
    taken = [BLANK, "randomization.all=0.2", "--output", tmp_path / "file"]
    assert (
        run_script("drones", *taken) == 2
        and "file/drone_0_0.yaml: cannot be written" in capsys.readouterr().err
    )
    assert run_script("drones", BLANK, "randomization.all=0.2", *draw) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    config = load_config(BLANK, ["randomization.all=0.2"])
    drawn = draw_drones(config, 8, 3)  # the first two are possible bodies
    nominal = race_of(config)[1].vehicle.constants
    for index in range(2):
        file = tmp_path / f"drone_3_{index}.yaml"
        own = load_config(BLANK, [f"vehicle={file}"]).vehicle.constants
        for name, value in own.items():
            assert value == pytest.approx(float(getattr(drawn, name)[index]), rel=1e-5)
    assert 0.01 < abs(own["k_w"] / float(nominal.k_w) - 1.0) < 0.2
    assert run_script("drones", BLANK, *draw) == 2
    assert "randomization draws no constants" in capsys.readouterr().err


@pytest.mark.slow
def test_a_policy_that_observes_the_thrust_knows_it(tmp_path, monkeypatch, capsys):
    (tmp_path / "shown.py").write_text(
        "from quadjax import Field\n\n\n"
        "def thrust(view):\n    return (1e8 * view.state.constants.k_w,)\n\n\n"
        'THRUST = Field("thrust", size=1, unit="", frame="", range=8.0, value=thrust)\n'
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    race = [str(BLANK), "randomization={thrust: 0.2, lag: 0.2}"]
    files = [tmp_path / "shown.npz", tmp_path / "plain.npz"]
    for file, extra in zip(files, ("[shown:THRUST]", "[]"), strict=True):
        untrained_policy(load_config(race[0], [race[1], f"observation.extra={extra}"])).save(file)
    written = tmp_path / "probe.json"
    options = ["--drones", "200", "--seconds", "2", "--json", str(written)]
    command = [*race, "observation.extra=[shown:THRUST]", *options]
    figure = ["--figure", str(tmp_path / "probe.png")]
    assert run_script("probe", *command, "--policy", files[0], "--policy", files[1], *figure) == 0
    shown, plain = json.loads(written.read_text())["probes"]
    assert shown["policy"] == "shown" and shown["held_out"] == 100
    names = list(shown["r_squared"]["observation"])  # accelerations are reached through the lag
    assert (names[0], names[-1]) == ("thrust to weight", "tau")
    assert shown["r_squared"]["observation"]["thrust to weight"] > 0.99
    assert shown["r_squared"]["observation"]["tau"] < 0.3
    assert plain["r_squared"]["layer 1"]["tau"] < 0.3
    assert (tmp_path / "probe.png").stat().st_size > 5000
    assert "| shown | observation |" in capsys.readouterr().out
