"""The files of INDIflight: the exported C around that firmware's interface.

``neural_network.c`` is the network's source with ``nn_forward``, ``nn_controller.c`` the source of
the observation and of the gates with ``nn_reset`` and ``nn_control``; so the firmware compiles the
same functions as every other target. ``indiflight_2026/`` has the float network in the form of the
firmware of 2026, untested.
"""

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.emit import Provenance, Values, calls_per_step, common_values
from quadjax.export.fixed import FixedNetwork
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import RaceTables
from quadjax.export.render import render
from quadjax.export.targets import check_model
from quadjax.policy.file import Policy
from quadjax.race import episode

MOST_GATES = 255  # of target_gate_index, a uint8_t
# INDIflight's number of the motors front-left, front-right, rear-right, rear-left.
MOTORS = (3, 1, 0, 2)
CALL_RATE = 500  # Hz, of nn_control: every 20th inner loop
SELF_TEST_INFERENCES = 40  # of about as many instructions as all self-tests
FOLDER, FOLDER_2026 = "indiflight", "indiflight_2026"


def check_indiflight(network: FixedNetwork, race: RaceTables) -> None:
    """Check that INDIflight can fly a policy.

    Raises:
        InputError: commands that are no motor commands from 0 to 1, or too many gates.
    """
    low, high = (
        x / 2.0**network.fraction_bits for x in (network.command_low, network.command_high)
    )
    check_model("indiflight", network.model.name)
    if np.any(low < 0.0) or np.any(high > 1.0):
        raise InputError(
            f"--target indiflight: motor commands {low.tolist()}..{high.tolist()}, allowed: 0 to 1"
        )
    if race.gates > MOST_GATES:
        raise InputError(f"--target indiflight: {race.gates} gates, allowed: {MOST_GATES}")


def emit_indiflight(
    files: dict[str, str],
    network: FixedNetwork,
    origin: Provenance,
    race: RaceTables,
    own: OwnRace,
    policy: Policy,
) -> dict[str, str]:
    """INDIflight's files, by path.

    Args:
        files: the emitted network and race, by name.
        network: the integers.
        origin: for the comments.
        race: the integers of the observation.
        own: the race, whose gates the firmware is told.
        policy: the float network, for the form of 2026.
    """
    check_indiflight(network, race)
    parts = {"header": ".h", "source": ".c", "race_header": "_race.h", "race_source": "_race.c"}
    values = common_values(network, origin) | _track(own) | {"race": race, "motors": MOTORS}
    values |= {part: _inlined(files[f"{origin.name}{end}"], origin) for part, end in parts.items()}
    middle = 0.5 * (network.command_low + network.command_high) / 2.0**network.fraction_bits
    step = race.time_step
    fits = not race.box.layout.counts_steps or calls_per_step(CALL_RATE, step)
    values |= {
        "call_rate": CALL_RATE if fits else round(1.0 / step),
        "period_ns": round(step * 1e9),
    }
    values |= {"halfway": middle, "selftest_inferences": SELF_TEST_INFERENCES}
    names = [f"{stem}.{end}" for stem in ("neural_network", "nn_controller") for end in "hc"]
    found = {f"{FOLDER}/{name}": render(f"indiflight/{name}", values) for name in names}
    values["layers"] = [(kernel.T, bias) for kernel, bias in policy.layers]
    values["std"] = np.exp(policy.log_std)
    text = render("indiflight/nn_2026.c", values)
    return found | {f"{FOLDER_2026}/nn_{origin.name}.c": text}


def _inlined(text: str, origin: Provenance) -> str:
    """An emitted file without the lines that include the other ones."""
    own = (f'#include "{origin.name}.h"', f'#include "{origin.name}_race.h"')
    return "".join(line for line in text.splitlines(True) if line.strip() not in own)


def _track(own: OwnRace) -> Values:
    """Gates and the start, as floats: m and rad, north-east-down."""
    track = own.params.track
    drone = episode.hover_start(own.choices, own.params).drone
    return {
        "gate_positions": np.stack([np.asarray(x) for x in track.position.components()], axis=1),
        "gate_yaws": np.asarray(track.yaw),
        "start_position": np.array([float(x) for x in drone.position.components()]),
        "start_yaw": float(drone.angles.z),
    }
