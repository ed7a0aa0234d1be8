"""The hand-over of a rate policy's commands to an autopilot's inner loop, as a file."""

import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from quadjax.core.vectors import Rotors, Vec3
from quadjax.export.convert import export_c
from quadjax.export.inner_loop import EFFECTIVENESS, RANGE
from quadjax.plant import indi
from quadjax.plant.config import IndiConfig
from quadjax.vehicle.protocol import Measurement
from quadjax.vehicle.rate import RateCommand
from tests import reference as ref
from tests.convert import constants
from tests.export.support import made


def exported(folder, target, name="indi"):
    """The file of a made-up policy that is exported for a target, or None."""
    out, policy = folder / target, made(name)[0]
    export_c(policy, out, name="made", target=target, allow_unfinished=True)
    path = out / "inner_loop.yaml"
    return yaml.safe_load(path.read_text()) if path.exists() else None


def test_the_file_has_commands_units_limits_and_rates(no_flights, tmp_path):
    found = exported(tmp_path, "cortex-a9")
    commands = found["commands"]
    assert [c["name"] for c in commands] == ["p", "q", "r", "thrust"]
    assert [c["unit"] for c in commands] == ["rad/s"] * 3 + ["m/s^2"]
    assert [[c["low"], c["high"]] for c in commands] == [[-3, 3]] * 3 + [[0, 15]]
    assert [c.get("scale") for c in commands] == [4096, 4096, 4096, None]
    assert (found["commands_hz"], found["training_hz"]) == (512, 100)
    assert found["response"] == {"rates": 0.03, "thrust": 0.03}
    assert found["format"] == "quadjax-inner-loop/1" and found["autopilot"] == "Paparazzi"
    other = exported(tmp_path, "cortex-m7")
    assert all("scale" not in c for c in other["commands"]) and other["commands_hz"] is None
    assert exported(tmp_path, "cortex-m4", "e2e") is None


def run(params, commands, rpm, rates, force):
    """Rpm commands (n, 4) of a loop along measurements, and its thrust estimates (n,)."""
    state, rows, thrusts = None, [], []
    for command, w, gyro, f in zip(commands, rpm, rates, force, strict=True):
        vectors = (Vec3(*map(jnp.float32, gyro)), Vec3(*map(jnp.float32, f)))
        measured = Measurement(*vectors, Rotors(*map(jnp.float32, w)), Vec3.zero())
        state = indi.init(params, measured) if state is None else state
        p, q, r, thrust = map(jnp.float32, command)
        state, rotors = indi.update(params, state, measured, RateCommand(Vec3(p, q, r), thrust))
        rows.append([float(x) for x in rotors.components()])
        thrusts.append(float(state.thrust))
    return np.array(rows), np.array(thrusts)


@pytest.fixture
def loops(no_flights, tmp_path):
    """The file, the plant's inner loop, and the one of the file's airframe alone."""
    found = exported(tmp_path, "cortex-a9")
    other = dict.fromkeys(ref.MOTOR, np.nan) | found["airframe"]  # nothing else is used
    assert set(found["airframe"]) == {*EFFECTIVENESS, *RANGE}
    airframes = (constants("motor", values) for values in (ref.MOTOR, other))
    return found, *(indi.indi_params(airframe, IndiConfig(), 500.0) for airframe in airframes)


def test_the_plants_inner_loop_flies_by_the_file(loops):
    found, plant, of_file = loops
    rng = np.random.default_rng(0)
    low, high = ([c[end] for c in found["commands"]] for end in ("low", "high"))
    commands = rng.uniform(low, high, (12, 4))
    rpm, rates = rng.uniform(6000, 9000, (12, 4)), rng.uniform(-2, 2, (12, 3))
    force = np.column_stack([rng.uniform(-1, 1, (12, 2)), -rng.uniform(5, 14, 12)])
    wanted, thrust = run(plant, commands, rpm, rates, force)
    np.testing.assert_array_equal(run(of_file, commands, rpm, rates, force)[0], wanted)
    assert np.all(np.isfinite(thrust))
    scale = found["commands"][0]["scale"]
    handed = np.column_stack([np.round(commands[:, :3] * scale) / scale, commands[:, 3]])
    assert 0 < np.abs(handed - commands).max() <= 0.5 / 4096
    assert np.abs(run(of_file, handed, rpm, rates, force)[0] - wanted).max() < 30.0


def test_the_throttle_is_the_steady_state_of_the_plants_loop(loops):
    found, plant, _ = loops
    hover = found["throttle"]["hover"]
    assert hover == {"thrust": 9.81, "rpm": 7497.4, "pprz": 5397}
    commands, still = np.array([[0.0, 0.0, 0.0, hover["thrust"]]] * 5), np.zeros((5, 3))
    force = still + [0.0, 0.0, -hover["thrust"]]
    rotors, thrust = run(plant, commands, np.full((5, 4), hover["rpm"]), still, force)
    np.testing.assert_allclose(rotors, hover["rpm"], atol=1.0)
    np.testing.assert_allclose(thrust, hover["thrust"], atol=1e-3)
    assert found["throttle"]["low"]["pprz"] == 0 and found["throttle"]["high"]["rpm"] < 11000
