"""The C of the shipped policies: the hash of every C file and header in ``shipped_c.json``.

The vectors of the self-tests are drawn here rather than taken from simulated flights, which differ
in the last bits between processors. ``python -m tests.export.test_shipped`` writes the hashes.
"""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from quadjax.core.resources import PRETRAINED
from quadjax.export.conversion import Options, convert_policy
from quadjax.export.flights import Rollouts
from quadjax.export.race_source import own_race
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy

HASHES = Path(__file__).parent / "shipped_c.json"
NAMES = sorted({path.stem for path in PRETRAINED.glob("*.npz")} - {"standin_residual"})
CASES = [*NAMES, "e2e with e2e_shac"]
ROWS = 200


def hashes_of(case: str) -> dict[str, str]:
    """SHA-256 of every C file and header of a policy, with or without a config, by name."""
    name, _, config = case.partition(" with ")
    path = PRETRAINED / f"{name}.npz"
    policy = Policy.load(path)
    chosen, origin = race_of_policy(policy, path, "e2e" if config else None)
    own = own_race(chosen, policy, origin)
    nothing = Rollouts(*(np.zeros((0, 1)),) * 3)
    options = Options(name)
    found = convert_policy(policy, own, options, path.name, path, nothing)
    rng = np.random.default_rng(0)
    rollouts = Rollouts(
        rng.uniform(-0.25, 0.25, (ROWS, found.network.inputs)).astype(np.float32),
        rng.uniform(-0.25, 0.25, (ROWS, found.race.state_size)).astype(np.float32),
        rng.integers(0, found.race.gates, ROWS).astype(np.int32),
    )
    files = dataclasses.replace(found, rollouts=rollouts).sources()
    return {
        file: hashlib.sha256(text.encode()).hexdigest()
        for file, text in sorted(files.items())
        if file.endswith((".c", ".h"))
    }


@pytest.mark.parametrize("case", CASES)
def test_the_c_of_a_shipped_policy_stays_the_same(case):
    assert hashes_of(case) == json.loads(HASHES.read_text())[case]


def test_the_hashes_are_of_the_shipped_policies():
    assert list(json.loads(HASHES.read_text())) == CASES


if __name__ == "__main__":
    text = json.dumps({case: hashes_of(case) for case in CASES}, indent=2)
    HASHES.write_text(text + "\n")
