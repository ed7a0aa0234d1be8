"""What ``benchmarks.calibration_likelihood`` compares with the real flights, of simulated ones."""

import numpy as np
from scipy.signal import lfilter

from benchmarks.calibration_likelihood import SHOWN
from quadjax.plant.flights import PlantFlights, extract_rows

MODEL_TAU, HIGHEST = 0.06, 12000.0  # s and rpm, of the first-order model
LEAST_SPREAD = 0.01  # s


def summary(name: str, flights: PlantFlights, drones: int) -> dict[str, np.ndarray]:
    """The ``NUMBERS`` (drones,) of one policy; NaN where too few flights tell."""
    frames, laps = flights.frames, flights.laps.lap_times
    laps = laps.reshape(-1, drones, laps.shape[1])  # (flights, drones, laps)
    done = np.isfinite(laps).all(axis=2)
    laps = np.where(done[..., None] & (done.sum(axis=0) >= 3)[:, None], laps, np.nan)
    mean, spread = np.nanmean(laps, axis=0), np.nanvar(laps, axis=0, ddof=1).mean(axis=1)
    result = {f"{name} lap {lap + 1}": mean[:, lap] for lap in range(mean.shape[1])}
    result[f"{name} spread"] = 0.5 * np.log(spread + LEAST_SPREAD**2)
    finished = done.sum(axis=0)
    result[f"{name} finished"] = np.log((finished + 0.5) / (len(done) - finished + 0.5))
    numbers = []
    for run in range(drones):
        rpm, command = (
            extract_rows(flights, x, run) for x in (frames.true.actuators, frames.rpm_command)
        )
        place = extract_rows(flights, frames.true.position, run)[:, :2]
        numbers.append((0.5 * np.ptp(place, axis=0).mean(), *deviation(rpm, command, flights.step)))
    whole = np.where(done[0, :, None], np.array(numbers), np.nan)
    result[f"{name} half width"] = whole[:, 0]
    return result | (dict(zip(SHOWN, whole[:, 1:].T, strict=True)) if name == "E2E" else {})


def deviation(rpm: np.ndarray, command: np.ndarray, step: float) -> tuple[float, float, float]:
    """Highest speed, rpm; 95% of the deviation from the first-order model; its frequency, Hz.

    Of speeds and commands (n, 4) at steps, s; NaN of a flight of less than 2 s.
    """
    if len(rpm) < 2.0 / step:
        return np.nan, np.nan, np.nan
    change = step / MODEL_TAU
    reachable = np.minimum(command, HIGHEST)
    modeled, _ = lfilter([0.0, change], [1.0, change - 1.0], reachable, axis=0, zi=rpm[:1])
    error = (rpm - modeled)[round(1.0 / step) :]
    power = (np.abs(np.fft.rfft(error - error.mean(axis=0), axis=0)) ** 2).sum(axis=1)
    frequency = np.fft.rfftfreq(len(error), step)
    near = (frequency > 2.0) & (frequency < 25.0)
    center = float((frequency * power)[near].sum() / power[near].sum())
    return float(np.quantile(rpm, 0.999)), float(np.quantile(np.abs(error), 0.95)), center
