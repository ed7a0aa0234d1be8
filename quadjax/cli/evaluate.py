"""``quadjax evaluate``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import note, steps, wrote
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED, policy_names

DRAWINGS = ("states", "figure", "figure_3d", "signals", "attitude", "animation")
RECORDED = Group("Recorded flights, in place of policies", sort_key=2)
States = Annotated[
    Path | None,
    opt.Output((".npz", ".csv")),
    Parameter(metavar="FILE.npz|.csv", group=opt.FILES),
]
Animation = Annotated[
    Path | None, opt.Output((".gif",)), Parameter(metavar="FILE.gif", group=opt.FILES)
]


def evaluate(
    config: Annotated[opt.Config | None, Parameter(name="CONFIG")] = None,
    /,
    *overrides: opt.Overrides,
    policy: list[opt.PolicyFile] | None = None,
    study: Literal["laps", "protocols", "spread", "races", "random-tracks"] | None = None,
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
    logs: Annotated[opt.Logs, Parameter(group=RECORDED)] = opt.PLAIN_LOGS,
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
        policy: Policy file, folder of a run, or name of a shipped policy; may be repeated.
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
        report: Folder of the tables and figures.
        json: Write the laps, or the numbers of a study.
        states: Write all trajectories.
        figure: Draw the flight from two sides.
        figure_3d: Draw the flight in perspective.
        signals: Draw actuators and rates over time.
        attitude: Draw height and attitude over time.
        animation: Animate the flight.
    """
    if flights is not None:
        opt.refuse_others("with --flights", "flights", "logs", "report", "overwrite")
        return _report(config or "e2e", overrides, flights, logs, report, overwrite)
    opt.refuse("without --flights", "logs", "report", "overwrite")
    opt.exclude("laps", "gates")
    if policy is None and config is not None:
        raise InputError("--policy is missing: the file of the policy, or a shipped one's name")
    options, files = locals(), policy or [PRETRAINED / f"{name}.npz" for name in policy_names()]
    study = study or ("laps" if len(files) == 1 else "protocols")
    if len(files) > 1 and study != "protocols":
        raise InputError(f"--policy: {len(files)} policies, allowed: 1 with --study {study}")
    with loading():
        from quadjax.core.files import write_json
        from quadjax.studies.policy_studies import STUDIES, Entry, write_files

    others = ("policy", "study", "json", *(DRAWINGS if study == "laps" else ()))
    used = opt.options_of(STUDIES[study], options, f"with --study {study}", *others)
    try:
        entries = [Entry.read(file, config, overrides, note) for file in files]
    except InputError as error:
        text = str(error).replace("config=CONFIG", "quadjax evaluate CONFIG")
        raise InputError(text) from None
    drawings = {option: options[option] for option in DRAWINGS if options[option] is not None}
    with steps() as show:
        show("compiling and simulating")
        result = STUDIES[study](entries, show, **used)
        if json is not None:
            write_json(json, result.record)
        if result.evaluation is not None:
            write_files(result.evaluation, drawings, show)
    print(result.text)
    wrote(json, *drawings.values())


def _report(
    config: str,
    overrides: Sequence[str],
    flights: Sequence[str],
    logs: opt.Logs,
    folder: Path,
    overwrite: bool,
) -> None:
    """Tables and figures of recorded flights."""
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.folders import results
        from quadjax.sources import load_groups
        from quadjax.studies.report.run import FILES as REPORT_FILES
        from quadjax.studies.report.run import write_report

    race = load_config(config, overrides)
    groups = load_groups(flights, race.track, logs.columns() if logs.logs else None)
    with results(folder, "report", REPORT_FILES, overwrite) as new:
        text = write_report(groups, race, new)
    print(text)
    wrote(f"{folder}/")
