"""Learn from flights: fit the model to a policy's logs, fine-tune the policy on it, compare."""

from pathlib import Path

import numpy as np

import quadjax

FOLDER = Path("learned")
POLICY = "e2e"  # a shipped policy, trained on the nominal Bebop 1


def fly(race, plant):
    """Fly and log the policy on a plant; with your own drone, return the paths of its logs."""
    (FOLDER / "logs").mkdir(parents=True, exist_ok=True)
    plan = quadjax.plan_logs(race, plant, POLICY, flights=4, laps=6)
    files, _ = quadjax.write_logs(plan, POLICY, FOLDER / "logs")
    return sorted(str(file) for file in files)


def fit(logs):
    """Fit the model to logs; returns the overrides of a race with it. See FOLDER/report.txt."""
    words = [f"logs.files={logs}", "residual.mirror=false"]  # this plant's drone is not symmetric
    config = quadjax.load_fit_config("paparazzi", words)
    quadjax.write_fit(quadjax.fit(config, report=print), FOLDER)
    return [f"vehicle={FOLDER / 'vehicle.yaml'}", f"vehicle.residual={FOLDER / 'residual.npz'}"]


def main():
    race = quadjax.load("e2e")
    plant = quadjax.load_plant_config("cyberzoo", ["drone=3"])  # one of its drones
    model = fit(fly(race, plant))
    tuning = quadjax.load("e2e", [*model, "run.steps=1000000"])
    run = quadjax.train(quadjax.fine_tuning(tuning, POLICY), FOLDER / "run", overwrite=True)
    print("policy  finished  time of all laps, s")
    for name, policy in (("before", POLICY), ("after", run.policy)):
        how = {"runs": 10, "drones": 1, "deterministic": True, "seed": 1}
        laps = quadjax.evaluate(policy, race, plant=plant, **how)
        mean = np.mean(laps.totals[np.isfinite(laps.totals)])
        print(f"{name:<8}{laps.finished:>4}/10{mean:>22.2f}")


if __name__ == "__main__":
    main()
