"""Evaluate policies by mean and by sampled flights, from hover and from random starts.

Prints a line for each policy file or folder of a training run; without arguments, for each shipped
policy. A policy is evaluated in the race that it was trained in, or in that of --race, which
key=value overrides change. The table contains a published time only next to flights of the
same race and protocol.
"""

import argparse
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.cli.arguments import Parser, check_outputs, is_override, parse, runs
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED, policy_names

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.evaluation.protocols import Protocols


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("results", description=__doc__)
    parser.add_argument(
        "policies",
        nargs="*",
        metavar="FILE.npz|RUN|key=value",
        help="policy files, folders of runs, overrides of --race (default: the shipped policies)",
    )
    parser.add_argument("--race", metavar="CONFIG", help="preset or YAML file, for all policies")
    parser.add_argument("--runs", type=runs, default=100, help="flights of each kind (100)")
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    options = parse(parser, argv)
    check_outputs(options, json=(".json",))
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly and tabulate."""
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.config.loading import load_config
        from quadjax.core.files import write_json
        from quadjax.core.provenance import provenance
        from quadjax.evaluation.protocols import protocol_table
        from quadjax.training.progress import bar

    overrides = [each for each in options.policies if is_override(each)]
    paths = [Path(each) for each in options.policies if each not in overrides]
    if overrides and options.race is None:
        raise InputError(f"{overrides[0]}: overrides change the race of --race, which is missing")
    race = load_config(options.race, overrides) if options.race else None
    results, console = [], Console(stderr=True)

    def note(line: str) -> None:
        console.print(line, highlight=False, soft_wrap=True)

    with bar(counted=True, console=console) as progress:
        chosen = paths or shipped_policies()
        task = progress.add_task("", total=len(chosen))
        for path in chosen:
            progress.update(task, description=path.name)
            results.append(fly_one(path, race, options.runs, note))
            progress.advance(task)
    print(protocol_table(results))
    if options.json:
        rows = [each.to_json() for each in results]
        write_json(options.json, {"results": rows, "provenance": provenance(race)})
        console.print(f"wrote {options.json}", highlight=False)
    return 0


def shipped_policies() -> list[Path]:
    """The policy files that come with the package."""
    return [PRETRAINED / f"{name}.npz" for name in policy_names()]


def fly_one(
    path: Path, race: "Config | None", flights: int, report: Callable[[str], None]
) -> "Protocols":
    """Both protocols of one policy.

    Args:
        path: of a policy file, or of the folder of a training run.
        race: to fly in; None for that of the policy's training.
        flights: of each kind.
        report: called with a line of text if the race is that of a preset.

    Raises:
        InputError: a file that cannot be used.
    """
    from quadjax.evaluation.evaluation import evaluate
    from quadjax.evaluation.protocols import fly_protocols
    from quadjax.policy.file import Policy
    from quadjax.policy.race import policy_path, race_of_policy
    from quadjax.training.paper import published_sampled

    file = policy_path(path)
    policy = Policy.load(file)
    config, _ = race_of_policy(policy, file, race, report=report)
    fly = functools.partial(evaluate, policy, config, runs=flights, name=str(file))
    label = path.name if path.is_dir() else path.stem
    return fly_protocols(fly, label, policy.log_std, published_sampled(config))
