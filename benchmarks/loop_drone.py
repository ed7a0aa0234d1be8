"""A drone of ``benchmarks.loop``: its logs and fit, the policies trained for it, their flights."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import quadjax
from benchmarks.loop_results import (
    CHOSEN,
    E2E,
    LIMITS,
    fastest_limit,
    logged_thrust,
    mean_thrust,
)
from quadjax.cli.fit import fit
from quadjax.cli.logs import logs
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation.responses import response
from quadjax.plant.config import load_plant_config

FIRST = ("e2e_residual_disturbance", "indi")  # their flights are logged
FIT = ("logs.min_seconds=1", "logs.max_scale_error=0.5", "figures=false")
SHORT = ("split.folds=3",)  # fewer trainings
FULL = "schedules.vehicle.residual_gain=null"  # from the first step: the first policies fly without
AHEAD = "start.heading=inside_turn"  # otherwise some policies turn against the track
LEARNER = ("learner.optimizer=adam", "learner.num_envs=256", "learner.critic_epochs=4")
TURN = "schedules.start.yaw_deg={linear: [0.0, value], from: 0.2, until: 0.5}"
CONTENDERS: dict[str, tuple[str, ...]] = {
    "E2E, residual": ("e2e", "+residual", FULL),
    E2E: ("e2e", "+residual", "+disturbance", FULL),
    **{f"INDI, T {t}": ("indi", AHEAD, TURN, f"vehicle.constants.thrust_max={t}") for t in LIMITS},
}
REPORTED = {"simulated": 0, "flown": 1}  # seeds of the noise of the flights
RUNS = {"laps": 6, "deterministic": True, "runs": 10}


@dataclasses.dataclass(frozen=True)
class Drone:
    """A drone of the plant, its folder, and the steps for which policies are trained for it."""

    plant: str
    number: int
    folder: Path
    steps: int

    def identify(self) -> Path:
        """The folder of the fit to logs of the first policies."""
        written, found = self.folder / "logs", self.folder / "fit"
        if not list(written.glob("*.csv")):
            files = [PRETRAINED / f"{name}.npz" for name in FIRST]
            words = (self.plant, f"drone={self.number}")
            logs(*words, output=written, policy=files, race="e2e +disturbance")
        if not (found / "vehicle.yaml").exists():
            words = (f"logs.files=[{(written / '*.csv').resolve()}]", *FIT, *SHORT)
            fit("standin_identified", *words, output=self.folder, name="fit")
        return found

    def contend(self, name: str, seed: int) -> Mapping[str, Any]:
        """A contender's flights in its training race and on the drone, with its model's errors."""
        path = self.folder / f"{name}, seed {seed}.json"
        made_with = {"plant": self.plant, "steps": self.steps}
        if path.exists():
            record = read_json(path)
            if made_with.items() <= record.items():
                return record
            raise InputError(f"{path}: of another plant or number of steps; name another --output")
        model = self.identify()
        words = [*CONTENDERS[name], *LEARNER, f"seed={seed}", f"run.steps={self.steps}"]
        words += [f"vehicle.file={model / 'vehicle.yaml'}"]
        words += [f"vehicle.residual={model / 'residual.npz'}"] * ("+residual" in words)
        config = quadjax.load(words[0], words[1:])
        run = quadjax.train(config, self.folder / "runs" / path.stem, resume=True)
        still = config.replace(disturbance=type(config.disturbance)())
        drone = load_plant_config(self.plant, [f"drone={self.number}"])
        record, flights = dict[str, Any](made_with), []
        for key, noise in ({CHOSEN: 0} | REPORTED).items():
            plant = None if key == "simulated" else drone
            flown = quadjax.evaluate(run.policy, still, plant=plant, seed=noise, **RUNS)
            record[key], flights = flown.laps.to_json(), flown.flights
        errors = [response(flight, config.vehicle) for flight in flights]
        record["errors"] = np.mean([x.rms for x in errors if x is not None], axis=0).tolist()
        record["thrust"] = mean_thrust(flights)
        write_json(path, record)
        return record

    def tune(self, seed: int) -> str:
        """The contender with the limit of INDI that is fastest where every flight finishes.

        The limits of seed 0 are the mean thrust in the logs of INDI, rounded, and all above it in
        steps of 1 m/s^2; lower ones until every flight finishes. Other seeds have two of these
        limits: the fastest of seed 0, and the fastest before the first with crashes.
        """
        self.identify()
        first = round(logged_thrust(self.folder / "logs"))
        limit, tried = first, set[int]()
        while limit in LIMITS and limit not in tried:
            tried.add(limit)
            flown = self.contend(f"INDI, T {limit}", 0)[CHOSEN]
            limit += 1 if flown["finished"] == flown["runs"] else -1
        for limit in range(first, LIMITS.stop):
            self.contend(f"INDI, T {limit}", 0)
        for name in {fastest_limit(self.folder, 0, tried), fastest_limit(self.folder, 0)}:
            self.contend(name, seed)
        return fastest_limit(self.folder, seed)
