"""Whole races through every autopilot's glue, with lost and late states, under sanitizers."""

import dataclasses
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest

from quadjax.core.resources import PRETRAINED
from quadjax.export.race_source import policy_race
from quadjax.export.verify.toolchain import host
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import run, source
from quadjax.sil.faults import Faults
from quadjax.sil.run import Setting, fly_all
from quadjax.sil.source import ExportedC
from tests.export.support import converted_in

RACER = Path(__file__).parent / "racer.npz"  # of the 5-inch drone, without rotor speeds
PERIOD = 0.002  # s, of the plant's control loop
SANITIZERS = "-std=c99 -fsanitize=address,undefined -fno-sanitize-recover=all -g -O1".split()
GLUES = {  # policy, target, and whether it flies on the plant
    "paparazzi": (PRETRAINED / "e2e_residual_disturbance.npz", "cortex-a9", True),
    "paparazzi, rates": (PRETRAINED / "indi.npz", "cortex-a9", True),
    "indiflight": (RACER, "indiflight", False),
}
REPLAY = """
#include <stdio.h>
#include "firmware.h"
const char *sil_load(void);
void sil_begin(void);
void sil_step(double time_s, const qj_vehicle *state, float to[QJ_COMMANDS]);
int main(void) {
  double time_s;
  qj_vehicle state;
  float command[QJ_COMMANDS];
  if (sil_load() != 0) { return 1; }
  sil_begin();
  while (fread(&time_s, sizeof(time_s), 1, stdin) == 1) {
    if (fread(&state, sizeof(state), 1, stdin) != 1) { return 2; }
    sil_step(time_s, &state, command);
    fwrite(command, sizeof(command), 1, stdout);
  }
  return 0;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", GLUES)
def test_a_whole_race_through_the_glue(name, tmp_path, monkeypatch):
    """A program with sanitizers gives the commands of the race for its states again."""
    path, target, on_plant = GLUES[name]
    states, commands, build, step = [], [], source.build_autopilot, ExportedC.step

    def built(sources, output, others, options):
        (tmp_path / "replay.c").write_text(REPLAY)
        files, of_glue = sources.autopilot()
        compiler = dataclasses.replace(host(), flags=tuple(SANITIZERS))
        options_of_all = [*of_glue, *options, "-ffp-contract=off", "-lm"]
        files += [*others, tmp_path / "replay.c"]
        compiler.build(files, tmp_path / "replay", options_of_all)
        return build(sources, output, others, options)

    def recorded(self, time, state):
        states.append(np.float64(time).tobytes() + state.tobytes())
        commands.append(step(self, time, state))
        return commands[-1]

    monkeypatch.setattr(source, "build_autopilot", built)
    monkeypatch.setattr(ExportedC, "step", recorded)
    faults = Faults(drop=0.1, late=0.1, delay=PERIOD if on_plant else 5 * PERIOD)
    policy = Policy.load(path)
    config, origin = race_of_policy(policy)
    converted = converted_in(tmp_path, policy, policy_race(config, policy, origin), target, 512.0)
    monkeypatch.setattr(run, "read_folder", lambda *_: converted)
    plant = load_plant_config("standin") if on_plant else None
    flown = fly_all(Setting(tmp_path, plant, laps=1, faults=faults), threading.Event())
    assert flown.laps.crashes == ("",), flown.text()
    assert ("its own estimator" in flown.autopilot) == (name == "paparazzi")
    assert "autopilot: nan steps" not in flown.counts and "in the glue of" in flown.sources
    program, data = [str(tmp_path / "replay")], b"".join(states)
    done = subprocess.run(program, input=data, capture_output=True, check=True)
    again = np.frombuffer(done.stdout, np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(again, np.array(commands))
