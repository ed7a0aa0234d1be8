"""``quadjax evaluate``."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.export import Ranges
from quadjax.cli.output import steps, wrote
from quadjax.core.errors import InputError
from quadjax.core.files import write_json
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED, policy_names

if TYPE_CHECKING:
    from quadjax.config.schema import Config as RaceConfig
    from quadjax.evaluation.conditions import Conditions
    from quadjax.evaluation.result import Evaluation
    from quadjax.policy.file import Policy
    from quadjax.race.laps import Actor

States = Annotated[
    Path | None, opt.Output((".npz", ".csv")), Parameter(metavar="FILE.npz|.csv", group=opt.FILES)
]


def evaluate(
    config: Annotated[opt.ConfigName | None, Parameter(name="CONFIG")] = None,
    /,
    *overrides: opt.Overrides,
    policy: tuple[opt.PolicyFile, ...] | None = None,
    conditions: opt.Conditions = None,
    only: opt.Labels = None,
    laps: opt.Laps | None = None,
    gates: opt.Gates | None = None,
    seconds: Annotated[float | None, opt.number(0.01, 1e4)] = None,
    runs: opt.Runs | None = None,
    start: Literal["hover", "random", "around", "before_gate"] | None = None,
    seed: opt.Seed = 0,
    deterministic: opt.Flag = False,
    plant: opt.PlantConfig | None = None,
    drones: opt.Drones | None = None,
    fixed_point: opt.Flag = False,
    range_: Ranges | None = None,
    body: Annotated[opt.Positive | None, Parameter(metavar="RADIUS")] = None,
    offsets: opt.Flag = False,
    format: Literal["text", "markdown", "latex"] | None = None,
    json: opt.JsonFile = None,
    states: States = None,
    figures: Annotated[opt.Folder | None, Parameter(group=opt.FILES)] = None,
) -> None:
    """Time the laps of policies, next to the published ones of the same race, if any.

    One policy is evaluated with sampled actions, as the paper does, and with the
    mean action. The files show the sampled runs, or the deterministic ones with
    --deterministic. Without CONFIG a policy flies the race that it was trained in;
    a warning says where CONFIG differs from it.
    Several policies, each with its own --policy, are compared in one table; without
    CONFIG and --policy, those that come with the package.

    With --conditions, the policies fly under each condition of a list:

    - protocols: mean and sampled, from hover and from random starts (the default of
      several policies);
    - spread: crashes and median lap of 1000 flights of 12 s from 1 m before a gate,
      with all constants drawn from ±0, 10, 20 and 30%;
    - races: whole races from around the track's start, with drawn constants;
    - random-tracks: one flight from hover on each of --runs random tracks, those of
      randomization.tracks with the seeds that follow;
    - damage: moments, thrust, residual, a damaged rotor, a shifted mass;
    - plants: drawn drones of a plant, without each effect, and with each alone;
    - rates: the policy at 100, 250 and 512 Hz on drawn drones of a plant.

    Example: quadjax evaluate --policy e2e --laps 6 --figures lap

    Args:
        policy: Policy file, folder of a run, or name of a shipped policy; may be repeated.
        laps: Laps of a run (default: evaluate.laps).
        gates: Gates of a run, in place of laps.
        seconds: Seconds of a run, in place of laps.
        runs: Number of runs (default: of the conditions, or evaluate.runs).
        start: hover (the default), around it, random (the states of training), or before_gate.
        seed: Seed of noise, disturbances and starts.
        deterministic: Mean actions only.
        plant: Fly on the plant of this config.
        drones: Number of drones of the plant, which share the runs (default: as many of its
            population as share them equally).
        fixed_point: Use the arithmetic of the exported C.
        range_: With --fixed-point: a range that the C was exported with.
        body: Radius of the drone, m: gates, bounds and ground are closer by it.
        offsets: Print the distances from the gates' centers.
        format: Format of the table (default: text, with --conditions markdown).
        json: Write the laps, or the numbers of the conditions.
        states: Write all trajectories.
        figures: Draw the flight: trajectory.png, perspective.png and signals.png.
    """
    opt.exclude(laps=laps, gates=gates, seconds=seconds)
    if plant is None:
        opt.refuse("without --plant", drones=drones)
    opt.check_shares(runs, drones)
    if policy is None and config is not None:
        raise InputError("--policy is missing: the file of the policy, or a shipped one's name")
    if not fixed_point:
        opt.refuse("without --fixed-point", range_=range_)
    ranges = opt.by_name("--range", range_)
    files = list(policy or ()) or [PRETRAINED / f"{name}.npz" for name in policy_names()]
    of_laps: dict[str, object] = {"fixed_point": fixed_point, "range_": range_, "offsets": offsets}
    of_laps |= {"states": states, "figures": figures}
    given = {"start": start, "deterministic": deterministic}
    named = "protocols" if conditions is None and len(files) > 1 else conditions
    listed = _listed(named, only, of_laps, given)
    entries = [_entry(file, config, overrides) for file in files]
    with loading():
        from quadjax.evaluation.evaluate import evaluate as fly
        from quadjax.evaluation.result import merge_evaluations

    how: dict[str, Any] = {"laps": laps, "gates": gates, "seconds": seconds, "runs": runs}
    how |= {"start": start, "seed": seed, "plant": plant, "drones": drones, "body_radius": body}
    with steps() as show:
        show("compiling and simulating")
        if listed is None:
            if fixed_point:
                how["actor"] = _fixed_point(*entries[0][1], ranges)
            flown = _modes(*entries[0], deterministic, how)
        else:
            how |= {"conditions": listed, "progress": show, "deterministic": deterministic or None}
            flown = [fly(*entry, name=file, **how) for file, entry in entries]
        result = merge_evaluations(flown)
        text = result.table(format) + (_offsets(flown[0]) if offsets else "")
        _write(flown[0] if listed is None else result, json, states, figures)
    print(text)
    wrote(json, states, f"{figures}/" if figures else None)


def _listed(
    name: str | None,
    only: list[str] | None,
    of_laps: Mapping[str, object],
    given: Mapping[str, object],
) -> "Conditions | None":
    """A list of conditions, if one is named; options without effect are refused.

    Options ``of_laps`` have one without conditions, those ``given`` where not all conditions set
    them.
    """
    from quadjax.evaluation.conditions import read_conditions

    if name is None:
        opt.refuse("without --conditions", only=only)
        return None
    listed = read_conditions(name, only)
    opt.refuse(f"with --conditions {name}", **of_laps)
    for key, value in given.items():
        if all(getattr(condition, key) is not None for condition in listed.conditions):
            opt.refuse(f"with --conditions {name}", **{key: value})
    return listed


def _entry(
    path: Path, config: str | None, overrides: Sequence[str]
) -> tuple[str, tuple["Policy", "RaceConfig"]]:
    """The path of a policy file; the policy and the race that it flies."""
    with loading():
        from quadjax.config.assembly import make_race
        from quadjax.config.loading import load_config
        from quadjax.policy.file import Policy
        from quadjax.policy.pilot import adapt_race
        from quadjax.policy.race import race_of_policy

    race = None if config is None else load_config(config, overrides)
    policy = Policy.load(path, race)
    race, _ = race_of_policy(policy, path, race)
    adapt_race(*make_race(race), policy, str(path))
    return str(path), (policy, race)


def _fixed_point(policy: "Policy", race: "RaceConfig", ranges: Mapping[str, float]) -> "Actor":
    """The arithmetic of C that is exported with ranges, as an actor."""
    from quadjax.config.assembly import make_race
    from quadjax.export.emulator import fixed_point_fly
    from quadjax.export.ranges import track_ranges

    _, params = make_race(race)
    return fixed_point_fly(policy, track_ranges(policy.layout, params.track) | dict(ranges))


def _modes(
    file: str, entry: tuple["Policy", "RaceConfig"], deterministic: bool, how: Mapping[str, Any]
) -> list["Evaluation"]:
    """Flights of one policy: sampled and of the mean action, or of that only."""
    from quadjax.evaluation.evaluate import evaluate as fly

    if "actor" not in how:
        modes = (True,) if deterministic else (False, True)
        return [fly(*entry, name=file, deterministic=mean, **how) for mean in modes]
    flown = fly(*entry, name=file, deterministic=True, **how)
    label = flown.row.condition.replace("deterministic", "fixed point, mean")
    return [dataclasses.replace(flown, rows=(dataclasses.replace(flown.row, condition=label),))]


def _offsets(evaluation: "Evaluation") -> str:
    """A line on the distances from the gates' centers; none where no gate is passed."""
    import numpy as np

    offsets = evaluation.gate_offsets
    if not offsets.size:
        return ""
    wide = np.percentile(offsets, 95.0)
    mean = f"mean {offsets.mean():.3f} m, 95% within {wide:.3f} m"
    return f"\ndistance from the gates' centers: {mean}"


def _write(
    evaluation: "Evaluation",
    json: Path | None,
    states: Path | None,
    figures: Path | None,
) -> None:
    """Write the files that are asked for."""
    from quadjax.core.plotting import save_figure

    if states is not None:
        evaluation.save_states(states)
    if figures is not None:
        for name, figure in evaluation.figures().items():
            save_figure(figure, figures / f"{name}.png")
    if json is not None:
        write_json(json, evaluation.to_json())
