"""Draw the drones of the plant ``cyberzoo`` from the posterior of ``benchmarks.calibrate``.

python -m benchmarks.cyberzoo_population E2E.npz INDI.npz benchmarks/cyberzoo.npz

Draws of the posterior fly both policies again. Of those with which nine of ten flights finish, as
no crash of the real drone is reported, the twenty that their own flights make likeliest are written
to ``configs/plant/cyberzoo.yaml``. Prints the flights.
"""

from pathlib import Path

import numpy as np

from benchmarks.calibrate import drones_of, told
from benchmarks.calibration_emulator import posterior, stored
from benchmarks.calibration_fleet import Fleet
from benchmarks.calibration_likelihood import FINISHED, NUMBERS, log_likelihood
from quadjax.cli import options, script
from quadjax.core.files import read_text, write_text
from quadjax.core.resources import CONFIGS

FILE = CONFIGS / "plant" / "cyberzoo.yaml"
DRAWN, DRONES, FLIGHTS, SHARE = 64, 20, 24, 0.9
SEED = 20_000  # of the flights


def cyberzoo_population(e2e: options.PolicyFile, indi: options.PolicyFile, file: Path, /) -> None:
    """Write the drones of the plant."""
    drawn = posterior(file)[:DRAWN]
    fleet = Fleet({"E2E": e2e, "INDI": indi})
    numbers = fleet.fly(drones_of(drawn), DRAWN, FLIGHTS, SEED)
    logits = numbers[:, [NUMBERS.index(key) for key in FINISHED]]
    safe = (1.0 / (1.0 + np.exp(-logits)) >= SHARE).all(axis=1)
    print(f"{DRAWN} drones: {told(numbers)}")
    log = np.where(safe, log_likelihood(numbers, stored(file)[2]), -np.inf)
    chosen = np.sort(np.argsort(-log)[:DRONES])
    print(f"{safe.sum()} of them, with which {SHARE:.0%} finish: {told(numbers[safe])}")
    print(f"{len(chosen)} of these: {told(numbers[chosen])}")
    text = read_text(FILE).split("population:\n")[0] + "population:\n"
    for key, values in drones_of(drawn[chosen]).population.items():
        text += f"  {key}: [{', '.join(f'{x:.4g}' for x in values)}]\n"
    write_text(FILE, text)


if __name__ == "__main__":
    script(cyberzoo_population)
