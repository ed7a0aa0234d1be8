"""``quadjax evaluate``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import note, steps, write_record, wrote
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED, policy_names

if TYPE_CHECKING:
    from quadjax.config.schema import Config as TrainingConfig
    from quadjax.evaluation.evaluation import Evaluation
    from quadjax.policy.file import Policy

RECORDED = Group("Recorded flights, in place of policies", sort_key=2)
States = Annotated[
    Path | None,
    opt.Output((".npz", ".csv")),
    Parameter(metavar="FILE.npz|.csv", group=opt.FILES),
]
Animation = Annotated[
    Path | None, opt.Output((".gif",)), Parameter(metavar="FILE.gif", group=opt.FILES)
]
Study = Literal["laps", "protocols", "spread", "races", "random-tracks"]
USED: Mapping[str, set[str]] = {  # options that have an effect on each study, apart from laps
    "protocols": {"runs", "json"},
    "spread": {"runs", "seconds", "seed", "json"},
    "races": {"runs", "laps", "gates", "seed", "json"},
    "random-tracks": {"runs", "laps", "json"},
    "flights": {"flights", "logs", "allow_code", "report", "overwrite"},
}
FIGURES = {  # methods of an evaluation by the options that write their figures
    "figure": "plot",
    "figure_3d": "plot_3d",
    "signals": "plot_signals",
    "attitude": "plot_attitude",
}


def evaluate(
    config: Annotated[opt.Config | None, Parameter(name="CONFIG")] = None,
    /,
    *overrides: opt.Overrides,
    policy: list[opt.PolicyFile] | None = None,
    study: Study | None = None,
    laps: opt.Laps | None = None,
    gates: opt.Gates | None = None,
    runs: opt.Runs | None = None,
    start: Literal["hover", "random"] = "hover",
    seed: opt.Seed = 0,
    deterministic: opt.Flag = False,
    fixed_point: opt.Flag = False,
    range_: Annotated[list[str] | None, Parameter(name="--range", metavar="FIELD=R")] = None,
    body: Annotated[opt.Positive | None, Parameter(metavar="RADIUS")] = None,
    seconds: opt.Count | None = None,
    offsets: opt.Flag = False,
    flights: Annotated[list[str] | None, Parameter(metavar="[LABEL=]FILE", group=RECORDED)] = None,
    logs: Annotated[opt.FitConfig | None, Parameter(group=RECORDED)] = None,
    allow_code: Annotated[opt.AllowCode, Parameter(group=RECORDED)] = False,
    report: Annotated[Path, Parameter(metavar="DIR", group=RECORDED)] = Path("runs/report"),
    overwrite: Annotated[opt.Overwrite, Parameter(group=RECORDED)] = False,
    json: opt.AnyFile = None,
    states: States = None,
    figure: opt.Picture = None,
    figure_3d: opt.Picture = None,
    signals: opt.Picture = None,
    attitude: opt.Picture = None,
    animation: Animation = None,
) -> None:
    """Time the laps of policies, next to the published ones of the same race, if any.

    One policy is evaluated with sampled actions, as the paper does, and with the
    mean action. The files show the sampled runs, or the deterministic ones with
    --deterministic. Without CONFIG a policy flies the race that it was trained in.
    Several policies, each with its own --policy, are compared in one table; without
    CONFIG and --policy, those that come with the package.

    The option --study selects other flights:

    - protocols: mean and sampled, from hover and from random starts (the table of
      several policies);
    - spread: crashes and median lap of 1000 flights of 12 s from 1 m before a gate,
      with all constants drawn from ±0, 10, 20 and 30%;
    - races: whole races from around the track's start, with drawn constants;
    - random-tracks: one flight from hover on each of --runs random tracks, those of
      randomization.tracks with the seeds that follow.

    With --flights, recorded flights are evaluated: states of an earlier --states
    FILE.npz, or flight logs (.csv, a glob pattern for several). DIR gets tables and
    figures as text, LaTeX, PDF, SVG and PNG. CONFIG is the race that was flown.

    Example: quadjax evaluate e2e --policy e2e_nominal --laps 6 --figure lap.png

    Args:
        policy: Policy file, folder of a run, or name of a shipped policy.
        study: Which flights are simulated (default: laps, of several policies protocols).
        laps: Laps of a run (default: evaluate.laps).
        gates: Gates of a run, in place of laps.
        runs: Number of runs (default: evaluate.runs, of a study 100 or 1000).
        start: Start from hover, or from the random states of training.
        seed: Of noise, disturbances and starts.
        deterministic: Mean actions only.
        fixed_point: Use the arithmetic of the exported C.
        range_: With --fixed-point: a range that the C was exported with.
        body: Radius of the drone, m: gates, bounds and ground are closer by it.
        seconds: Of a flight of the study spread.
        offsets: Print the distances from the gates' centers.
        flights: A group of flights, with its label; may be repeated.
        logs: Fit config whose section logs describes the columns of flight logs.
        report: Folder of the tables and figures.
        json: Write the laps, or the numbers of a study.
        states: Write all trajectories.
        figure: Draw the flight from two sides.
        figure_3d: Draw the flight in perspective.
        signals: Draw actuators and rates over time.
        attitude: Draw height and attitude over time.
        animation: Animate the flight.
    """
    options = {key: value for key, value in locals().items() if key not in ("config", "overrides")}
    if flights is not None:
        _refuse_others("flights", options)
        columns = (logs, allow_code)
        _report(config or "e2e", overrides, flights, columns, report, overwrite)
        return
    if laps is not None and gates is not None:
        raise InputError("--laps and --gates exclude each other")
    if range_ and not fixed_point:
        raise InputError("--range is allowed only with --fixed-point")
    if policy is None and config is not None:
        raise InputError("--policy is missing: the file of the policy, or a shipped one's name")
    files = policy or [PRETRAINED / f"{name}.npz" for name in policy_names()]
    study = study or ("laps" if len(files) == 1 else "protocols")
    if study == "laps":
        _refuse_others("laps", options)
    else:
        _refuse_others(study, {**options, "policy": None, "study": None})
    if study == "protocols":
        _protocols(files, config, overrides, runs or 100, json)
    elif len(files) > 1:
        raise InputError(f"--policy: {len(files)} policies, allowed: 1 with --study {study}")
    else:
        _evaluate(files[0], config, overrides, study, options)


def _refuse_others(study: str, options: Mapping[str, Any]) -> None:
    """Refuse options that have no effect on the flights of a study."""
    used = USED.get(study) or set(options) - USED["flights"] - {"seconds"}
    defaults = ("hover", 0, Path("runs/report"))
    for name, value in options.items():
        if name in used or value is None or value is False or value in defaults:
            continue
        kind = "--flights" if study == "flights" else f"--study {study}"
        raise InputError(f"--{name.strip('_').replace('_', '-')} is not allowed with {kind}")


def _evaluate(
    file: Path,
    config: str | None,
    overrides: Sequence[str],
    study: str,
    options: Mapping[str, Any],
) -> None:
    """The laps, or another study of one policy."""
    with loading():
        from quadjax.config.race import race_of
        from quadjax.evaluation.evaluation import lap_table
        from quadjax.policy import pilot
        from quadjax.policy.race import policy_path

    file = policy_path(file)
    race, policy = _race(file, config, overrides)
    pilot.fit_race(*race_of(race), policy, str(file))
    with steps() as report:
        report("compiling and simulating")
        if study == "laps":
            evaluations = _laps(race, policy, file, options)
            text = lap_table(evaluations)
        else:
            text, record = _study(study, race, policy, file, options)
    print(text)
    if study == "laps":
        _write(next(iter(evaluations.values())), options)
    else:
        from quadjax.core.provenance import provenance

        write_record(options["json"], record, provenance(race, str(file), options["seed"]))


def _race(
    file: Path, config: str | None, overrides: Sequence[str]
) -> tuple["TrainingConfig", "Policy"]:
    """A policy and the race that it flies: that of the config, or its own."""
    from quadjax.config.loading import load_config
    from quadjax.policy.file import Policy

    if config is None:
        policy = Policy.load(file)
        return _own_race(policy, file), policy
    race = load_config(config, overrides)
    return race, Policy.load(file, race)


def _own_race(policy: "Policy", file: Path) -> "TrainingConfig":
    """The race in which a policy was trained."""
    from quadjax.policy.race import race_of_policy

    try:
        return race_of_policy(policy, file, report=note)[0]
    except InputError as error:
        raise InputError(str(error).replace("config=CONFIG", "quadjax evaluate CONFIG")) from None


def _study(
    study: str, race: "TrainingConfig", policy: "Policy", file: Path, options: Mapping[str, Any]
) -> tuple[str, dict[str, Any]]:
    """The table and the numbers of a study."""
    from quadjax.race.random_track import RandomTracks
    from quadjax.studies.race_flights import fly_races, race_table
    from quadjax.studies.random_tracks import fly_random_tracks
    from quadjax.studies.robustness import fly_spreads, spread_table

    name, seed, laps = str(file), options["seed"], options["laps"]
    if study == "spread":
        seconds = options["seconds"] or 12
        spreads = fly_spreads(policy, race, options["runs"] or 1000, seconds, seed, name)
        rows = [row.to_json() for row in spreads]
        return spread_table(spreads, file.stem), {"seconds": seconds, "flights": rows}
    if study == "races":
        races = fly_races(policy, race, options["runs"] or 1000, laps, options["gates"], seed, name)
        return race_table(races), {"flights": [row.to_json() for row in races]}
    if laps == 1:
        raise InputError("--laps is 1, allowed: at least 2 with --study random-tracks")
    trained = race.randomization.tracks or RandomTracks()
    tracks = trained.replace(seed=trained.seed + trained.count, count=options["runs"] or 100)
    flown = fly_random_tracks(policy, race, tracks, laps or 3, name)
    return flown.table(), flown.to_json()


def _laps(
    race: "TrainingConfig", policy: "Policy", file: Path, options: Mapping[str, Any]
) -> "dict[str, Evaluation]":
    """Every line of the table by its label; the first is the one to save."""
    from quadjax.config.race import race_of
    from quadjax.evaluation.evaluation import evaluate

    common = {key: options[key] for key in ("runs", "laps", "gates", "start", "seed")}
    common |= {"name": str(file), "body_radius": options["body"]}
    if options["fixed_point"]:
        from quadjax.export.actor import fixed_point_fly
        from quadjax.export.race_tables import track_ranges
        from quadjax.export.ranges import parse_overrides

        _, params = race_of(race)
        ranges = track_ranges(policy.layout, params.track)
        actor = fixed_point_fly(policy, ranges | parse_overrides(options["range_"] or []))
        fixed = evaluate(policy, race, deterministic=True, actor=actor, **common)
        return {"fixed point, mean": fixed}
    evaluations = {}
    for deterministic in (True,) if options["deterministic"] else (False, True):
        result = evaluate(policy, race, deterministic=deterministic, **common)
        evaluations[result.label()] = result
    return evaluations


def _write(evaluation: "Evaluation", options: Mapping[str, Any]) -> None:
    """Write the JSON file, the figures and the animation that were asked for."""
    import numpy as np

    from quadjax.core.files import write_json
    from quadjax.core.plotting import save_figure

    if options["offsets"] and evaluation.gate_offsets.size:
        mean, wide = evaluation.gate_offsets.mean(), np.percentile(evaluation.gate_offsets, 95.0)
        print(f"distance from the gates' centers: mean {mean:.3f} m, 95% within {wide:.3f} m")
    if options["json"]:
        write_json(options["json"], evaluation.to_json())
    if options["states"]:
        evaluation.save_states(options["states"])
    for option, method in FIGURES.items():
        if options[option]:
            save_figure(getattr(evaluation, method)(), options[option])
    if options["animation"]:
        from quadjax.evaluation.animation import frame_count
        from quadjax.training.progress import bar

        with bar() as progress:
            task = progress.add_task("animation", total=frame_count(evaluation.flights))
            evaluation.animate(options["animation"], lambda: progress.advance(task))
    wrote(*(options[option] for option in ("json", "states", *FIGURES, "animation")))


def _protocols(
    files: Sequence[Path],
    config: str | None,
    overrides: Sequence[str],
    runs: int,
    json: Path | None,
) -> None:
    """One table of several policies: mean and sampled, from hover and from random starts."""
    with loading():
        import functools

        from quadjax.config.loading import load_config
        from quadjax.core.provenance import provenance
        from quadjax.evaluation.evaluation import evaluate
        from quadjax.evaluation.protocols import fly_protocols, protocol_table
        from quadjax.evaluation.published import published_sampled
        from quadjax.policy.file import Policy
        from quadjax.policy.race import policy_path
        from quadjax.training.progress import bar

    race = load_config(config, overrides) if config is not None else None
    results = []
    with bar(counted=True) as progress:
        task = progress.add_task("", total=len(files))
        for path in files:
            progress.update(task, description=path.name)
            policy = Policy.load(file := policy_path(path))
            flown = race or _own_race(policy, file)
            fly = functools.partial(evaluate, policy, flown, runs=runs, name=str(file))
            label = path.name if path.is_dir() else path.stem
            results.append(fly_protocols(fly, label, policy.log_std, published_sampled(flown)))
            progress.advance(task)
    print(protocol_table(results))
    write_record(json, {"results": [row.to_json() for row in results]}, provenance(race))


def _report(
    config: str,
    overrides: Sequence[str],
    flights: Sequence[str],
    columns: tuple[str | None, bool],
    folder: Path,
    overwrite: bool,
) -> None:
    """Tables and figures of recorded flights."""
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.folders import results
        from quadjax.fitting.config import load_fit_config
        from quadjax.studies.report.flights import find_flights
        from quadjax.studies.report.run import FILES as REPORT_FILES
        from quadjax.studies.report.run import write_report

    race = load_config(config, overrides)
    fit, allow_code = columns
    logs = None if fit is None else load_fit_config(fit, allow_code=allow_code).logs
    groups = find_flights(flights, race.track, logs)
    with results(folder, "report", REPORT_FILES, overwrite) as new:
        text = write_report(groups, race, new)
    print(text)
    wrote(f"{folder}/")
