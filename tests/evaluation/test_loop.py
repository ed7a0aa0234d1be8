"""The benchmark that fits drones to flights, trains for them and flies again: its choices."""

import numpy as np
import pytest

from benchmarks.loop_drone import Drone
from benchmarks.loop_figure import loop_figure
from benchmarks.loop_results import E2E, mean_thrust
from benchmarks.loop_tables import loop_tables
from quadjax.core.files import write_json
from quadjax.flights.flight import Flight, Signal


def record(total: float, finished: int = 2, thrust: float = 13.0) -> dict:
    """Two flights of six equal laps, of which some finish."""
    laps = [[total / 6] * 6 if run < finished else [None] * 6 for run in range(2)]
    totals = [total if run < finished else None for run in range(2)]
    flown = {"laps": laps, "totals": totals, "finished": finished, "runs": 2}
    still = {"laps": [[(total - 1.0) / 6] * 6]}
    errors = {"errors": [0.1, 0.2, 0.3, 0.4], "thrust": thrust}
    return {"chosen": flown, "flown": flown, "simulated": still} | errors


class Flown(Drone):
    """A drone that INDI flies, faster with more thrust: up to 14 m/s^2, and with 18 for seed 0."""

    tried: list[tuple[int, int]] = []  # noqa: RUF012

    def identify(self):
        (self.folder / "logs").mkdir(parents=True, exist_ok=True)
        lines = f"time,ekf_U3\n0,{-self.steps / 10}\n1,{-self.steps / 10}\n"
        (self.folder / "logs" / "indi_0.csv").write_text(lines)
        return self.folder

    def contend(self, name, seed):
        limit = int(name.removeprefix("INDI, T "))
        self.tried.append((limit, seed))
        result = record(40.0 - limit, 2 if limit <= 14 or (limit, seed) == (18, 0) else 1)
        write_json(self.folder / f"{name}, seed {seed}.json", result)
        return result


@pytest.mark.parametrize(("logged", "lowest"), [(12.6, 13), (16.0, 14), (14.4, 14)])
def test_the_limit_of_indi_is_the_fastest_with_which_every_flight_finishes(
    tmp_path, logged, lowest
):
    Flown.tried.clear()
    drone = Flown("cyberzoo", 1, tmp_path, round(10 * logged))
    assert [drone.tune(seed) for seed in (0, 1)] == ["INDI, T 18", "INDI, T 14"]
    assert {limit for limit, seed in Flown.tried if seed == 0} == set(range(lowest, 21))
    assert {limit for limit, seed in Flown.tried if seed == 1} == {14, 18}


def test_a_lead_is_of_the_same_drone_and_an_interval_over_drones(tmp_path, capsys):
    for drone, e2e, indi in ((1, 15.0, 19.0), (2, 18.0, 24.0)):
        write_json(tmp_path / f"{drone}" / f"{E2E}, seed 0.json", record(e2e))
        write_json(tmp_path / f"{drone}" / "INDI, T 13, seed 0.json", record(indi, drone))
    loop_tables(tmp_path, drones=(1, 2))
    printed = capsys.readouterr().out
    assert f"| {E2E} | 2 | 15.50 ± 19.06 | 16.50 ± 19.06 | 4 of 4 | +1.00 ± 0.00 |" in printed
    assert "| INDI, tuned | 2 | 20.50 ± 31.77 | 21.50 ± 31.77 | 3 of 4 | +1.00 ± 0.00 |" in printed
    assert "| 1 | 13 | 19.00 | 1 of 2 | 15.00 | 2 of 2 | 4.00 |" in printed
    assert "| 6 | 2.58 ± 3.18 | 2.75 ± 3.18 | 3.42 ± 5.29 | 3.58 ± 5.29 | 0.83 ± 2.12 |" in printed
    loop_figure(tmp_path, tmp_path / "loop.png", drones=(1, 2))
    assert (tmp_path / "loop.png").stat().st_size > 10_000


def test_the_mean_thrust_of_a_hover_at_a_roll_is_the_weight_over_its_cosine():
    time = np.linspace(0.0, 1.0, 101)
    roll = 0.5  # the drone accelerates to the side by g tan(roll)
    speed = np.outer(time, [0.0, 9.81 * np.tan(roll), 0.0])
    signals = {"velocity": Signal(speed), "position": Signal(np.zeros_like(speed))}
    signals["attitude"] = Signal(np.full((101, 3), [roll, 0.0, 0.0]))
    assert mean_thrust([Flight("a", time, signals)]) == pytest.approx(9.81 / np.cos(roll))
