"""Contenders on several drawn plants: with each effect switched off, and with each alone.

A plant is drawn by ``constants.seed``. An interval is that of the mean over the drawn plants, by
Student's distribution, so it contains the difference from drone to drone. Two contenders are
compared on the flights that both finish: the same plants, batteries and gusts.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator

import numpy as np
from scipy.stats import t as student

from quadjax.plant.config import DelayConfig, EffectsConfig, PlantConfig, without_effects
from quadjax.race.laps import Laps

EFFECTS = tuple(EffectsConfig.model_fields)
CHARGES = (1.0, 0.6, 0.2)  # of the battery at the start
CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class OnPlants:
    """Flights of one contender on each drawn plant."""

    laps: tuple[Laps, ...]

    @property
    def finished(self) -> int:
        """Flights that finished."""
        return sum(laps.finished for laps in self.laps)

    @property
    def runs(self) -> int:
        """All flights."""
        return sum(len(laps.crashes) for laps in self.laps)

    @property
    def crashes(self) -> dict[str, int]:
        """Number of flights that ended early, by reason."""
        return dict(Counter(crash for laps in self.laps for crash in laps.crashes if crash))

    @property
    def lap_means(self) -> np.ndarray:
        """Mean lap times (plants, laps), s, of the flights that finished; NaN without any."""
        rows = []
        for laps in self.laps:
            done = np.isfinite(laps.totals)
            times = laps.lap_times[done]
            rows.append(times.mean(axis=0) if done.any() else laps.lap_times[0] * np.nan)
        return np.stack(rows)

    @property
    def totals(self) -> np.ndarray:
        """Mean total times (plants,), s."""
        return self.lap_means.sum(axis=1)


def common_flights(first: OnPlants, second: OnPlants) -> tuple[OnPlants, OnPlants]:
    """Two contenders with the lap times of the flights that both finish, NaN of the others."""

    def masked(own: Laps, other: Laps) -> Laps:
        both = np.isfinite(own.totals) & np.isfinite(other.totals)
        return dataclasses.replace(own, lap_times=np.where(both[:, None], own.lap_times, np.nan))

    pairs = list(zip(first.laps, second.laps, strict=True))
    return (
        OnPlants(tuple(masked(own, other) for own, other in pairs)),
        OnPlants(tuple(masked(other, own) for own, other in pairs)),
    )


def interval(values: np.ndarray) -> tuple[float, float]:
    """Mean of the finite values (n,), and half the width of its 95% interval; NaN for fewer."""
    known = values[np.isfinite(values)]
    if not known.size:
        return float("nan"), float("nan")
    if known.size == 1:
        return float(known[0]), float("nan")
    width = student.ppf(0.5 + 0.5 * CONFIDENCE, known.size - 1) * known.std(ddof=1)
    return float(known.mean()), float(width / np.sqrt(known.size))


def show_interval(values: np.ndarray, sign: bool = False) -> str:
    """Mean and half-width of the interval as text."""
    mean, width = interval(values)
    if not np.isfinite(mean):
        return "-"
    text = f"{mean:+.2f}" if sign else f"{mean:.2f}"
    return text if not np.isfinite(width) else f"{text} ± {width:.2f}"


def conditions(plant: PlantConfig) -> dict[str, PlantConfig]:
    """The plant as it is, without each effect in turn, with each alone, and at several charges."""
    still = DelayConfig(command=0.0, measurement=0.0)
    exact = {"navigation": "ground_truth", "disturbance": "ground_truth"}
    none = without_effects(plant)
    result = {"all effects": plant}
    for name in EFFECTS:
        changed = plant.effects.replace(**{name: 0.0})
        result[f"without {name}"] = plant.replace(effects=changed)
    result["without delays"] = plant.replace(delay=still)
    result["with true states"] = plant.replace(**exact)
    for name in EFFECTS:
        alone = none.effects.replace(**{name: getattr(plant.effects, name)})
        result[f"only {name}"] = none.replace(effects=alone)
    result["only delays"] = none.replace(delay=plant.delay)
    result["no effect, no delay"] = none
    for charge in CHARGES:
        battery = plant.battery.replace(charge=(charge, charge))
        result[f"charge {charge:g}"] = plant.replace(battery=battery)
    return result


def drawn(plant: PlantConfig, count: int) -> Iterator[PlantConfig]:
    """The same plant with the constants of ``count`` drones, from the config's seed on."""
    for number in range(count):
        seed = plant.constants.seed + number
        yield plant.replace(constants=plant.constants.replace(seed=seed))


def plants_table(e2e: dict[str, OnPlants], indi: dict[str, OnPlants], count: int) -> str:
    """Both contenders under every condition as text, and E2E's lead on the same flights."""
    lines = [
        f"{count} drawn plants: total time, s, of the flights that both finish, with 95%",
        "intervals over the plants; finished: of all flights",
        f"{'':22}{'E2E':>15} {'finished':>9}{'INDI':>16} {'finished':>9}",
    ]
    notes = []
    for label, own in e2e.items():
        other = indi[label]
        pair = common_flights(own, other)
        lines.append(
            f"{label:22}{show_interval(pair[0].totals):>15} {own.finished:>4}/{own.runs:<4}"
            f"{show_interval(pair[1].totals):>16} {other.finished:>4}/{other.runs:<4}"
        )
        if pair[0].finished < own.runs:
            plants = int(np.isfinite(pair[0].totals).sum())
            notes.append(
                f"{label}: both finish {pair[0].finished} of {own.runs} flights, on {plants} of "
                f"{count} plants"
            )
    for name, flown in (("E2E", e2e), ("INDI", indi)):
        for label, own in flown.items():
            counts = ", ".join(f"{reason} {number}" for reason, number in own.crashes.items())
            notes += [f"{name}, {label}, early ends: {counts}"] if counts else []
    label = next(iter(e2e))
    first, second = common_flights(e2e[label], indi[label])
    ahead = second.lap_means - first.lap_means
    later = ahead[:, 1:].mean(axis=1) if ahead.shape[1] > 1 else ahead[:, 0] * np.nan
    lead = [
        f"E2E's lead, {label}: {show_interval(ahead.sum(axis=1), True)} s; first lap",
        f"{show_interval(ahead[:, 0], True)} s, each later lap {show_interval(later, True)} s",
    ]
    return "\n".join([*lines, *notes, *lead])
