"""Rows of lap times: policies flown by configs/conditions/protocols.yaml."""

import math
from collections.abc import Sequence
from pathlib import Path

import quadjax
from benchmarks import rows
from benchmarks.columns import CONDITIONS
from benchmarks.settings import Tree, check_run
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.training.result import Run


def flown(row: Tree, policies: Sequence[str]) -> Tree:
    """A row with the numbers of policies: of its shipped one, or of files or folders of runs.

    Raises:
        InputError: a policy for the row of a shipped one, or runs with other settings.
    """
    if bool(policies) == ("policy" in row):
        raise InputError(f"{row['name']}: allowed: {'no' if policies else 'one or several'} POLICY")
    paths = policies or [str(PRETRAINED / row["policy"])]
    runs = [quadjax.Run.load(path) for path in paths if Path(path).is_dir()]
    loaded = [run.policy for run in runs] or [quadjax.Policy.load(path) for path in paths]
    for run in runs:
        check_run(run, row)
    first, *words = row.get("race") or row["config"]
    race, options = quadjax.load(first, words), row.get("options", {})
    flights = [quadjax.evaluate(p, race, conditions="protocols", **options) for p in loaded]
    named = {name: [flight[name] for flight in flights] for name in CONDITIONS}
    return {
        **{key: value for key, value in row.items() if key != "kept"},
        "seeds": [policy.config and policy.config["seed"] for policy in loaded],
        "noise": [round(math.exp(policy.log_std.mean()), 2) for policy in loaded],
        "flights": flights[0].rows[0].runs,
        "finished": {name: [each.finished for each in some] for name, some in named.items()},
        "total": {
            name: [round(each.total, 2) if each.finished else None for each in some]
            for name, some in named.items()
        },
        "commit": rows.commit(),
        "machine": rows.device(),
        **(_trainings(runs) if runs else {}),
    }


def _trainings(runs: Sequence[Run]) -> Tree:
    """Steps and wall time of trainings, and their machine, if it is another one."""
    seconds = [run.summary["seconds"] for run in runs]
    devices = {run.summary["provenance"]["device"] for run in runs} - {rows.device()}
    return {
        "steps": runs[0].summary["steps"],
        "time": f"{min(seconds):.0f}-{max(seconds):.0f} s",
        "machine": "; trained on ".join([rows.device(), *sorted(devices)]),
    }
