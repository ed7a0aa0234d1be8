"""Is the navigation filter as good as it says? Its errors against its own standard deviations.

Flies policies in the race simulator, runs sensors and filter on each flight, and counts how often
every component is within three of its own standard deviations, and on how many flights the filter
diverged (half a metre, half a radian or 2 m/s off, or not finite). Exit status 1 where a component
is inside less than 99% of the time or a flight diverged. key=value words change the sensors
(sensors.mocap.latency=0.03), the filter (ekf.gyro_noise=1e-3) or the race.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from quadjax.cli.arguments import Parser, check_writable, count, parse, seed
from quadjax.config.loading import fill, load_config, parse_words
from quadjax.core.errors import InputError, command_line
from quadjax.core.files import write_json
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.plant.flights import Setting, plan_flights
from quadjax.plant.sensor_schema import NavigationConfig
from quadjax.plant.watch import COMPONENTS, Result, judge, onboard_of
from quadjax.policy.file import read_policy
from quadjax.training.progress import bar

WANTED = 0.99  # of the samples within three standard deviations
UNITS = ("m", "m/s", "rad", "rad/s", "m/s^2", "rad/s", "m/s^2")
SHIPPED = ("e2e", "indi")


def _arguments() -> argparse.Namespace:
    parser = Parser(prog="python -m quadjax.studies.consistency", description=__doc__)
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--config", help="YAML file of the race (both shipped policies' races)")
    parser.add_argument("--policy", metavar="FILE.npz", help="policy file (the shipped one)")
    parser.add_argument("--flights", type=count, default=1000, help="of each policy (1000)")
    parser.add_argument("--seconds", type=_positive, default=20.0, help="of each flight (20)")
    parser.add_argument("--rate", type=_positive, default=500.0, help="sample rate, Hz (500)")
    parser.add_argument("--start", choices=("hover", "random"), default="hover")
    parser.add_argument("--seed", type=seed, default=0, help="of policy noise and sensors")
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    arguments = parse(parser)
    check_writable(arguments.json)
    if arguments.policy and not arguments.config:
        raise InputError("--policy needs the --config of its race")
    return arguments


def _positive(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0.0 < number <= 1e4:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a number above 0, at most 10000")
    return number


def split_words(words: Sequence[str]) -> tuple[NavigationConfig, list[str]]:
    """Sensors and filter of ``key=value`` words, and the words that are the race's.

    Raises:
        InputError: an unknown key or a value of the wrong type.
    """
    own = [word for word in words if word.split("=")[0].split(".")[0] in ("sensors", "ekf")]
    config = fill(NavigationConfig, parse_words(own), "command line")
    return config, [word for word in words if word not in own]


def _flights(arguments: argparse.Namespace) -> list[tuple[str, str, str]]:
    """Name, config file and policy file of each set of flights."""
    if arguments.config:
        name = Path(arguments.config).stem
        return [(name, arguments.config, arguments.policy or str(PRETRAINED / f"{name}.npz"))]
    configs = CONFIGS
    return [(n, str(configs / f"{n}.yaml"), str(PRETRAINED / f"{n}.npz")) for n in SHIPPED]


def hit(result: Result) -> bool:
    """Whether the filter keeps what it promises."""
    return result.diverged == 0 and bool((result.inside >= WANTED).all())


def _print(name: str, result: Result) -> None:
    print(
        f"\n{name}: {result.flights} flights, {result.hours:.2f} h, {result.whole} to the end, "
        f"{result.diverged} diverged"
    )
    print(f"{'':>19} {'RMS error':>32} {'':7}{'inside 3 sigma, %':>22} {'mean (e/sigma)^2':>20}")
    for index, (component, unit) in enumerate(zip(COMPONENTS, UNITS, strict=True)):
        errors = "".join(f"{x:>10.5f}" for x in result.rmse[index])
        inside = "".join(f"{np.floor(1e4 * x) / 100:>8.2f}" for x in result.inside[index])
        ratio = "".join(f"{x:>7.2f}" for x in result.ratio[index])
        print(f"{component:>19} {errors} {unit:<7}{inside} {ratio}")
    print(f"{'hit' if hit(result) else 'missed'}: 99% inside, none diverged")


@command_line
def main() -> int:
    """Fly, judge, print, and write the numbers if asked."""
    arguments = _arguments()
    navigation, race = split_words(arguments.words)
    setting = Setting(
        arguments.rate,
        arguments.flights,
        arguments.seconds,
        arguments.start == "hover",
        arguments.seed,
    )
    sets = _flights(arguments)
    plans = {
        name: plan_flights(load_config(config, race), read_policy(policy), setting, policy)
        for name, config, policy in sets
    }
    for plan in plans.values():
        onboard_of(navigation, plan.sample_rate)  # complains before anything is flown
    results = {}
    with bar(console=Console(stderr=True)) as progress:
        for name, plan in plans.items():
            task = progress.add_task(name, total=plan.control_steps)
            results[name] = judge(
                plan, setting, navigation, lambda steps, task=task: progress.advance(task, steps)
            )
    for name, result in results.items():
        _print(name, result)
    if arguments.json:
        shown = {"setting": dataclasses.asdict(setting), "config": dataclasses.asdict(navigation)}
        numbers = {
            name: result.to_json() | {"hit": hit(result)} for name, result in results.items()
        }
        write_json(arguments.json, {**shown, "results": numbers})
        print(f"wrote {arguments.json}")
    return int(not all(hit(result) for result in results.values()))


if __name__ == "__main__":
    main()
