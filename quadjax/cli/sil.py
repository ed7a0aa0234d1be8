"""``quadjax sil``."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.export import Target
from quadjax.cli.output import steps, wrote
from quadjax.cli.view import view as show
from quadjax.core.errors import INTERRUPTED, InputError, quadjax_command
from quadjax.core.folders import kind_of, results
from quadjax.core.interruptions import interruptions, loading
from quadjax.core.resources import find_policy, policy_names
from quadjax.export.names import KIND, report_of
from quadjax.export.targets import DEFAULT_TARGET
from quadjax.sil.faults import FIELDS, WRONG_UNITS, Faults

if TYPE_CHECKING:
    from quadjax.sil.run import Flown

STOPPING = b"\nstopping: a flight that has begun is saved; Ctrl-C again ends without saving\n"
FAULTS = Group("Faults of the states", sort_key=2)
UNITS = tuple(WRONG_UNITS)
PLANT, DELAY = "cyberzoo", 20.0  # ms
OF_FIELD = f"FIELD=P with P of 0 to 1 and FIELD one of {', '.join(FIELDS)}"
OfField = Annotated[str, opt.named_number(OF_FIELD, lambda p: 0.0 <= p <= 1.0, tuple(FIELDS))]
OfFields = Annotated[tuple[OfField, ...] | None, Parameter(metavar="FIELD=P", group=FAULTS)]
Probability = Annotated[float, opt.number(0.0, 1.0, metavar="P", group=FAULTS)]


def _assignment(text: str) -> str:
    if not re.fullmatch(r"\w+=[\w.,+-]+", text):
        raise ValueError(f"{text!r}, allowed: NAME=VALUE, such as p_roll=60")
    return text


Assignment = Annotated[str, opt.reads(_assignment)]
Settings = Annotated[tuple[Assignment, ...] | None, Parameter(name="--set", metavar="NAME=VALUE")]


def sil(
    source: Annotated[opt.Export, Parameter(name="DIR|POLICY")],
    /,
    *overrides: opt.Overrides,
    target: Target | None = None,
    race: opt.Race = None,
    plant: opt.PlantConfig | None = None,
    simulator: opt.Flag = False,
    autopilot: Literal["betaflight"] | None = None,
    settings: Settings = None,
    laps: opt.Laps | None = None,
    runs: opt.Runs = 1,
    seed: opt.Seed = 0,
    drop: Probability = 0.0,
    late: Probability = 0.0,
    delay: Annotated[float | None, opt.number(0.0, 10_000.0, metavar="MS", group=FAULTS)] = None,
    stuck: OfFields = None,
    nan: OfFields = None,
    wrong_unit: Annotated[list[str] | None, Parameter(choices=UNITS, group=FAULTS)] = None,
    view: opt.Flag = False,
    name: opt.RunName = "sil",
    output: opt.RunsFolder = Path("runs"),
    overwrite: opt.Overwrite = False,
) -> int:
    """Fly exported C on a simulated drone: software in the loop.

    The C of DIR, a folder of quadjax export, or that of a policy is compiled for
    this machine, without the glue of an autopilot. It gets the drone's state at
    every control step and returns the command. The drone is a plant; key=value
    overrides change its config. With --simulator, it is the simulator that policies
    are trained in, which the models racing and a2rl need. With --autopilot
    betaflight, the C moves the sticks of Betaflight's firmware, which flies the
    model racing of the policy's vehicle in that simulator; its flights are also logs
    for quadjax fit betaflight. OUTPUT/NAME gets states.npz (for quadjax view and
    quadjax report), sil.json and table.txt.

    Example: quadjax sil e2e --late 0.2 --delay 20

    Args:
        source: Folder of quadjax export, a policy file, or a shipped policy's name.
        target: Processor and autopilot of a policy; that of DIR for a folder.
        race: Config of the race (default: config.yaml of DIR, or that of the policy).
        simulator: Fly in the simulator of the training.
        autopilot: A firmware that flies, for policies of the model rate.
        settings: Setting of the firmware, such as p_roll=60; may be repeated.
        laps: Laps of a run (default: evaluate.laps).
        runs: Number of runs.
        seed: Seed of drones and faults.
        drop: Probability that a state is lost.
        late: Probability that a state is late.
        delay: Delay of late states, ms (default: 20).
        stuck: Probability that a field has the numbers of the state before; may be repeated.
        nan: Probability that a number of a field is NaN; may be repeated.
        wrong_unit: Unit of a state's field; may be repeated.
        view: Show the flight in the browser.
    """
    name_of_source, source = source, _source_of(source)
    opt.exclude(plant=plant, simulator=simulator, autopilot=autopilot)
    if source.is_dir():
        opt.refuse("with the folder of an export", target=target)
    if not late:
        opt.refuse("without --late", delay=delay)
    if not autopilot:
        opt.refuse("without --autopilot", set=settings)
    plant, target = plant or PLANT, target or DEFAULT_TARGET
    if overrides and (simulator or autopilot):
        option = "--simulator" if simulator else "--autopilot"
        raise InputError(f"{overrides[0]} has no effect with {option}")
    if autopilot:
        faults_given = {"drop": drop, "late": late, "stuck": stuck, "nan": nan}
        named = {key: value or None for key, value in faults_given.items()}
        named |= {"seed": seed or None, "runs": None if runs == 1 else runs}  # flights repeat
        opt.refuse("with --autopilot", **named, wrong_unit=wrong_unit)
    opt.assigned("--set", settings)
    stuck_at, nans = opt.by_name("--stuck", stuck), opt.by_name("--nan", nan)
    units = tuple(wrong_unit or ())
    with loading():
        from quadjax.plant.config import load_plant_config
        from quadjax.sil.run import FILES, Setting, fly_all

    faults = Faults(drop, late, (DELAY if delay is None else delay) / 1000.0, stuck_at, nans, units)
    drone = None if simulator or autopilot else load_plant_config(plant, overrides)
    how = (laps, runs, seed, faults, race, target, (settings or ()) if autopilot else None)
    setting = Setting(source, drone, *how)
    folder = output / name
    with (
        results(folder, "flight", FILES, overwrite) as new,
        interruptions(STOPPING) as stop,
        steps() as report,
    ):
        flown = fly_all(setting, stop, report)
        flown.write(new)
    print(flown.text())
    wrote(f"{folder}/")
    return _shown(flown, folder, view, str(name_of_source))


def _shown(flown: "Flown", folder: Path, view: bool, source: str) -> int:
    """Show the flight, or say how, and what to do next; returns the exit status."""
    from quadjax.sil.fly import INTERRUPTED as STOPPED
    from quadjax.sil.run import STATES_FILE

    setting, last = flown.setting, flown.races[-1]
    if view and len(last.flight.time):
        show(str(folder / STATES_FILE), output=folder / "flight.html", open_=True)
    else:
        print(f"Next: {quadjax_command('view', folder / STATES_FILE)}")
    if not any(flown.laps.crashes) and not setting.faults and setting.source.is_file():
        words = ["export", source, "--target", setting.target, "--output", "out"]
        if setting.betaflight is not None:
            words = ["fit", "betaflight", f"logs.files={folder / 'log_*.csv'}", "--name", "fitted"]
        print(f"Then: {quadjax_command(*words)}")
    return INTERRUPTED if last.flight.crash == STOPPED else 0


def _source_of(source: Path) -> Path:
    """The folder of an export, or a policy file.

    Raises:
        InputError: there is none; with what to run instead.
    """
    if source.is_dir() and kind_of(source) == KIND:
        report_of(source)
        return source
    policy = find_policy(source)
    if policy.is_file() and kind_of(source) != KIND:
        return policy
    if source.is_dir():
        report_of(source)
        return source
    raise InputError(
        f"{source}: neither a folder of quadjax export nor a policy, allowed also: "
        f"{', '.join(policy_names())}"
    )
