"""Leave out each effect of ``cyberzoo``, alone and with all other numbers calibrated again.

python -m benchmarks.cyberzoo_effects E2E.npz INDI.npz benchmarks/cyberzoo.npz --output FILE.json
"""

from pathlib import Path
from typing import Annotated

import numpy as np

from benchmarks.calibrate import drones_of, told
from benchmarks.calibration_emulator import posterior, stored
from benchmarks.calibration_fleet import Fleet
from benchmarks.calibration_likelihood import LAPS, PRIORS, log_likelihood
from quadjax.cli import options, script
from quadjax.core.files import write_json


def cyberzoo_effects(
    e2e: options.PolicyFile,
    indi: options.PolicyFile,
    file: Path,
    /,
    *,
    output: Annotated[Path, options.Output((".json",))],
    drones: int = 24,
    flights: int = 8,
) -> None:
    """Leave out each effect, alone and with all other numbers calibrated again."""
    fleet, simulated = Fleet({"E2E": e2e, "INDI": indi}), stored(file)[2]
    chains = posterior(file)
    variants = {"all": chains[:drones]}
    for i, (key, prior) in enumerate(PRIORS.items()):
        share = min(max(prior.off_share, 0.0), 1.0)
        alone = chains[:drones].copy()
        alone[:, i] = share
        variants[f"without {key}"] = alone
        variants[f"without {key}, again"] = posterior(file, fixed=(i, share))[:drones]
    result = {}
    for name, shares in variants.items():
        numbers = fleet.fly(drones_of(shares), len(shares), flights, seed=10_000)
        log = log_likelihood(numbers, simulated)
        laps = np.nanmean(numbers[:, : len(LAPS)], axis=0)
        known = [None if np.isnan(x) else float(x) for x in (*laps, np.nanmedian(log))]
        result[name] = {"laps": known[:-1], "log_likelihood": known[-1], "text": told(numbers)}
        print(f"{name}: log-likelihood {known[-1]}; {told(numbers)}", flush=True)
    write_json(output, result)


if __name__ == "__main__":
    script(cyberzoo_effects)
