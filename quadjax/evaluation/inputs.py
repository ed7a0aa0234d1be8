"""What a policy gains from being told the disturbance: the same flights, with each input.

Starts, disturbances and noise are the same for every input; only what the observation says of the
disturbance differs: the truth, the onboard estimate, or zero. As a command::

    python -m quadjax.evaluation.inputs configs/e2e_disturbed.yaml --policy FILE.npz [key=value ...]
"""

import dataclasses

import numpy as np

from quadjax.cli.arguments import Parser, check_writable, count_up_to, parse, seed
from quadjax.config.loading import load_config
from quadjax.config.schema import MAX_LAPS, MAX_RUNS, Config, Gate
from quadjax.core.errors import command_line
from quadjax.core.files import write_json
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Race, fly_policy
from quadjax.race.laps import Trace

INPUTS = ("ground_truth", "estimated", "none")


@dataclasses.dataclass(frozen=True)
class InputResult:
    """The flights with one input."""

    finished: int
    runs: int
    seconds: float | None  # mean of all laps, over the runs that finished
    offset: float | None  # mean distance from a gate's centre, m
    wide: float | None  # the 95th percentile of it, m

    def row(self) -> str:
        """One line of the table."""
        numbers = ((self.seconds, 10, 2), (self.offset, 10, 3), (self.wide, 10, 3))
        cells = [f"{'-' if x is None else f'{x:.{digits}f}':>{w}}" for x, w, digits in numbers]
        return f"{f'{self.finished}/{self.runs}':>10}" + "".join(cells)


def gate_offsets(trace: Trace, gates: list[Gate]) -> np.ndarray:
    """How far from its gate's centre each passage was.

    Args:
        trace: what was flown.
        gates: of the track.

    Returns:
        The larger of the lateral and the vertical distance (n,), m, where the straight line between
        two samples crosses the gate's plane; all runs after one another. A missed gate is none.
    """
    target, position = np.asarray(trace.target), np.asarray(trace.position, np.float64)
    time, run = np.nonzero(target[1:] != target[:-1])
    passed = target[time, run]
    centre = np.array([gate.position for gate in gates], np.float64)[passed]
    yaw = np.radians([gate.yaw_deg for gate in gates])[passed]
    before, after = (position[t, :, run] - centre for t in (time, time + 1))
    through = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    behind, ahead = (before * through).sum(axis=1), (after * through).sum(axis=1)
    share = -behind / np.maximum(ahead - behind, 1e-12)
    crossing = before + share[:, None] * (after - before)
    lateral = -np.sin(yaw) * crossing[:, 0] + np.cos(yaw) * crossing[:, 1]
    return np.maximum(np.abs(lateral), np.abs(crossing[:, 2]))


def compare(config: Config, policy: Policy, race: Race, name: str) -> dict[str, InputResult]:
    """Fly the samples of a policy with the true, the estimated and no disturbance input.

    Args:
        config: of the race; its own ``observation.disturbance`` is not used.
        policy: the policy file's content.
        race: laps, runs and starts.
        name: the file, for messages.

    Raises:
        InputError: the policy does not fit the vehicle.
    """
    results = {}
    for word in INPUTS:
        told = config.at("observation.disturbance", word)
        laps, trace = fly_policy(told, policy, race, False, trace=True, name=name)
        offsets = gate_offsets(trace, config.track.gates)
        totals = laps.totals[np.isfinite(laps.totals)]
        results[word] = InputResult(
            finished=laps.finished,
            runs=race.runs,
            seconds=float(totals.mean()) if totals.size else None,
            offset=float(offsets.mean()) if offsets.size else None,
            wide=float(np.percentile(offsets, 95.0)) if offsets.size else None,
        )
    return results


def main() -> None:
    """Fly a policy with the true, the estimated and no disturbance input, and compare."""
    parser = Parser(description=main.__doc__)
    parser.add_argument("config", help="YAML file, as for training")
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--policy", required=True, metavar="FILE.npz", help="policy file")
    parser.add_argument(
        "--runs", type=count_up_to(MAX_RUNS), default=100, help="runs with each input (100)"
    )
    parser.add_argument(
        "--laps", type=count_up_to(MAX_LAPS), help="laps of a run (the config's, 6)"
    )
    parser.add_argument("--start", choices=("hover", "random"), default="random")
    parser.add_argument("--seed", type=seed, default=0, help="of noise, disturbances and starts")
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    words = parse(parser)
    check_writable(words.json)
    config, policy = load_config(words.config, words.words), Policy.load(words.policy)
    race = Race(words.laps or config.evaluate.laps, words.runs, words.start == "hover", words.seed)
    results = compare(config, policy, race, words.policy)
    print(f"{'input':10}{'finished':>10}{'mean, s':>10}{'offset, m':>10}{'95%, m':>10}")
    for word, result in results.items():
        print(f"{word:10}{result.row()}")
    if words.json:
        write_json(words.json, {word: vars(result) for word, result in results.items()})


if __name__ == "__main__":
    command_line(main)()
