"""Drones that fly as the real one did: a posterior of the numbers of the plant ``cyberzoo``.

Both published networks fly on drones drawn from priors; docs/guide/other_trainers.md imports them.
``benchmarks.calibration_likelihood`` has priors and likelihood, ``benchmarks.calibration_emulator``
what the simulated drones tell of others. Each round flies drones of the posterior so far, with a
likelihood that counts more from round to round.

    python -m benchmarks.calibrate E2E.npz INDI.npz --output benchmarks/cyberzoo.npz

A round is written when it is done; the same command continues.
"""

import time
from pathlib import Path
from typing import Annotated

import numpy as np

from benchmarks.calibration_emulator import CHAINS, FORMAT, fitted, sampled, stored
from benchmarks.calibration_fleet import Fleet, half_width
from benchmarks.calibration_likelihood import FINISHED, LAPS, NUMBERS, PRIORS, log_likelihood
from quadjax.cli import options, script
from quadjax.cli.options import whole
from quadjax.core.files import write_npz
from quadjax.plant.config import PlantConfig, load_plant_config

PLANT = "cyberzoo"
TEMPERS = (0.0, 0.0, 0.0, 0.03, 0.1, 0.3)  # of the first rounds, then 1


def drones_of(shares: np.ndarray) -> PlantConfig:
    """The plant with drones at shares (n, keys) of the priors."""
    values = {key: prior.value(shares[:, i]) for i, (key, prior) in enumerate(PRIORS.items())}
    columns = {key: tuple(map(float, column)) for key, column in values.items()}
    return load_plant_config(PLANT).replace(population=columns)


def told(numbers: np.ndarray) -> str:
    """Mean laps of both policies and the share that finishes, of simulated drones."""
    mean = dict(zip(NUMBERS, np.nanmean(numbers, axis=0), strict=True))
    return "; ".join(
        f"{key.split()[0]} {sum(mean[lap] for lap in laps):.2f} s, lap 1 {mean[laps[0]]:.2f}, "
        f"{100.0 / (1.0 + np.exp(-mean[key])):.0f}%"
        for key, laps in zip(FINISHED, (LAPS[:6], LAPS[6:]), strict=True)
    )


def calibrate(
    e2e: options.PolicyFile,
    indi: options.PolicyFile,
    /,
    *,
    output: Annotated[Path, options.Output((".npz",))],
    drones: Annotated[int, whole(16, CHAINS)] = 128,
    flights: Annotated[int, whole(4, 1000)] = 8,
    rounds: Annotated[int, whole(1, 1000)] = 19,
    seed: int = 0,
) -> None:
    """Sample drones from the posterior."""
    files = {"E2E": e2e, "INDI": indi}
    fleet, began = Fleet(files), time.monotonic()
    if output.exists():
        shares, numbers, simulated = stored(output)
    else:
        shares, numbers = np.zeros((0, len(PRIORS))), np.zeros((0, len(NUMBERS)))
        simulated = np.array([half_width(name, file) for name, file in files.items()])
    for number in range(len(shares) // drones, rounds):
        random = np.random.default_rng((seed, number))
        temper = TEMPERS[number] if number < len(TEMPERS) else 1.0
        chains = random.random((CHAINS, len(PRIORS)))
        if temper > 0.0:
            emulator = fitted(shares, numbers, simulated)
            for part in (0.1, 0.3, 1.0):  # from the prior to the posterior
                chains = sampled(emulator, chains, random, temper=part * temper)
        tried = chains[:drones]
        found = fleet.fly(drones_of(tried), drones, flights, seed + number)
        shares, numbers = np.concatenate([shares, tried]), np.concatenate([numbers, found])
        write_npz(
            output,
            {"shares": shares, "numbers": numbers, "simulated": simulated},
            {"format": FORMAT},
        )
        log = log_likelihood(found, simulated)
        print(
            f"round {number + 1}, {time.monotonic() - began:.0f} s, temper {temper:g}: "
            f"log-likelihood {np.nanmedian(log):.1f}; {told(found)}",
            flush=True,
        )


if __name__ == "__main__":
    script(calibrate)
