"""What a finished training run shows: its lap table and where its files are."""

from quadjax.files import write_json
from quadjax.schema import Config
from quadjax.training import Result, time_laps


def present(config: Config, result: Result) -> None:
    """Fly the best policy, print the lap table and write table and figures to the run."""
    sampled = time_laps(config, result.policy, False, config.evaluate.runs)
    steady = time_laps(config, result.policy, True, 1)
    write_json(
        result.directory / "laps.json",
        {"sampled": sampled.to_json(), "deterministic": steady.to_json()},
    )
    print(steady.to_json())
    print(f"Everything is in {result.directory}")
