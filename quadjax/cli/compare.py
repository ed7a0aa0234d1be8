"""``quadjax compare``."""

import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from quadjax.cli import options as opt
from quadjax.cli.output import wrote
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED

Several = Annotated[list[str] | None, Parameter(consume_multiple=True, metavar="NAME ...")]


def compare(
    config: Annotated[str, Parameter(name="CONFIG"), opt.config_of("plant")],
    /,
    *overrides: opt.Overrides,
    e2e: opt.PolicyFile = PRETRAINED / "e2e_nominal.npz",
    indi: opt.PolicyFile = PRETRAINED / "indi_shac.npz",
    race: Annotated[str, Parameter(metavar="CONFIG")] = "e2e",
    parts: Several = None,
    conditions: Several = None,
    plants: Annotated[int, Parameter(converter=opt.whole(1, 1000))] = 10,
    laps: opt.Laps = 6,
    runs: opt.Runs = 100,
    sampled: opt.Flag = False,
    seed: opt.Seed = 0,
    ablation: opt.Folder = PRETRAINED / "ablation",
    name: opt.RunName = "compare",
    output: opt.RunsFolder = Path("runs"),
    overwrite: opt.Overwrite = False,
) -> None:
    """Compare E2E and INDI in the simulator and on the stand-in plant.

    DIR/NAME gets table.txt, compare.json, config.yaml and figures. Overrides change
    the plant's config. The ablation evaluates the policies that are in its folder,
    and prints how to train those that are missing.

    Example: quadjax compare standin --parts table --runs 100

    Args:
        e2e: The default is e2e_nominal, which like indi_shac is not fitted to the plant.
        indi: The policy that commands thrust and rates.
        race: Preset or YAML file, whose vehicle is the model on board.
        parts: Some of the parts (default: all).
        conditions: Of the part plants: some of its rows, such as 'all effects' 'charge 0.2'
            (default: all).
        plants: Drawn plants, which share --runs.
        laps: Laps of a run.
        runs: Number of runs.
        sampled: Fly with the noise of training.
        seed: Of batteries, gusts and sensors.
        ablation: Folder of the ablation's policies.
    """
    started = time.monotonic()
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.folders import results
        from quadjax.plant.config import load_plant_config
        from quadjax.studies.comparison import Setting, contender
        from quadjax.studies.comparison_run import FILES, PARTS, Wanted, run_comparison
        from quadjax.training.progress import bar

    chosen, every = tuple(parts or PARTS), Wanted.conditions
    for option, values, allowed in (("parts", chosen, PARTS), ("conditions", conditions, every)):
        for value in values or ():
            if value not in allowed:
                raise InputError(f"--{option}: {value!r}, allowed: {', '.join(allowed)}")
    if conditions and "plants" not in chosen:
        raise InputError("--conditions has no effect without the part plants (--parts)")
    if "plants" in chosen and runs % plants:
        raise InputError(f"--runs is {runs}, allowed: multiples of --plants ({plants})")
    plant = load_plant_config(config, overrides)
    setting = Setting(load_config(race), plant, laps, runs, seed, plants, not sampled)
    contenders = (contender("E2E", str(e2e)), contender("INDI", str(indi)))
    for side, kind in zip(contenders, ("motor", "rate"), strict=True):
        if side.policy.vehicle != kind:
            raise InputError(
                f"{side.file}: a policy for the {side.policy.vehicle} vehicle, expected {kind} for "
                f"--{side.name.lower()}"
            )
    folder, console = output / name, Console(stderr=True)
    claimed = results(folder, "comparison", FILES, overwrite)
    with claimed as new, bar(counted=True, console=console) as progress:
        wanted = Wanted(chosen, ablation, new, tuple(conditions or every))
        task = progress.add_task("compiling", total=wanted.steps())

        def report(line: str) -> None:
            progress.update(task, description=line, advance=1)
            if not console.is_terminal:
                console.print(f"{time.monotonic() - started:5.0f} s  {line}", highlight=False)

        text = run_comparison(setting, contenders, wanted, report)
    print(text)
    wrote(f"{folder}/ in {time.monotonic() - started:.0f} s")
