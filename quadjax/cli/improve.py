"""``quadjax improve``."""

from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import command_again, steps
from quadjax.core.errors import INTERRUPTED
from quadjax.core.folders import claim, remove_files
from quadjax.core.interruptions import loading

FLIGHTS = Group("Flights on the plant", sort_key=2)
Rounds = Annotated[int, opt.whole(1, 100, group=FLIGHTS)]
ON_PLANT = ("rounds", "flights", "laps", "plant", "plant_seed", "seed", "check")
Check = Annotated[int, opt.whole(0, 10_000, group=FLIGHTS)]


def improve(
    config: opt.ConfigName,
    /,
    *overrides: opt.Overrides,
    policy: opt.PolicyFile,
    steps_: Annotated[int, opt.whole(1, 10**9, name="--steps")] = 1_000_000,
    fit: opt.FitConfig = "improve",
    allow_code: opt.AllowCode = False,
    logs: Annotated[list[str] | None, opt.LIST, Parameter(metavar="FILE ...")] = None,
    rounds: Rounds = 3,
    flights: Annotated[opt.Runs, Parameter(group=FLIGHTS)] = 2,
    laps: Annotated[opt.Laps, Parameter(group=FLIGHTS)] = 6,
    plant: Annotated[opt.PlantConfig, Parameter(group=FLIGHTS)] = "standin",
    plant_seed: Annotated[opt.Seed | None, Parameter(group=FLIGHTS)] = None,
    seed: Annotated[opt.Seed, Parameter(group=FLIGHTS)] = 0,
    check: Check = 10,
    output: Annotated[opt.Folder, opt.OutputFolder()] = Path("runs/improve"),
    overwrite: opt.Flag = False,
) -> int:
    """Improve a policy by its own flights: fly, refit the model, fine-tune, repeat.

    CONFIG is the race in which the policy was trained. The flights are on the
    stand-in plant, of which only the logs are read. A model that does not predict
    held-out flights better than the present one is rejected. DIR gets the logs, the
    model and the training of each round, policy.npz and table.txt.
    The same command resumes after a stop. With --logs it reads real logs instead:
    it prints what they change in the model and fine-tunes the policy, without
    flying.

    Example: quadjax improve e2e --policy e2e --rounds 3

    Args:
        policy: Policy file with its critic, or a shipped one's name.
        steps_: Environment steps of each fine-tuning.
        logs: Real logs, in place of flights.
        rounds: Number of rounds of flying and learning.
        flights: Flights in each round.
        laps: Laps of each flight.
        plant_seed: Seed of the plant's constants.
        seed: Seed of batteries, gusts and sensors.
        check: Flights that evaluate the first and the last policy.
        output: Folder of the results.
        overwrite: Replace earlier results.
    """
    with loading():
        from quadjax import improve as loop
        from quadjax.config.loading import load_config
        from quadjax.core.compilation_cache import enable_compilation_cache
        from quadjax.fitting.config import load_fit_config
        from quadjax.fitting.flight_log import find_logs
        from quadjax.learners.parallel import prepare_devices
        from quadjax.plant.config import load_plant_config

    race, model = load_config(config, overrides), load_fit_config(fit, allow_code=allow_code)
    files, drone = [], None
    if logs:
        opt.refuse("with --logs", *ON_PLANT)
        files = find_logs(model.logs.replace(files=tuple(logs)), Path())
    else:
        seeds = [] if plant_seed is None else [f"constants.seed={plant_seed}"]
        drone = load_plant_config(plant, seeds)
    numbers = rounds, flights, laps, steps_, check, seed
    setting = loop.Setting(race, policy, model, drone, tuple(files), *numbers)
    enable_compilation_cache()
    prepare_devices(race.run.devices)
    setting.check_policy()
    try:
        with claim(output, loop.KIND, loop.FILES, overwrite), steps() as report:
            if overwrite:
                remove_files(output, loop.FILES)
            setting.start(output)
            text = loop.improve(setting, output, report)
    except loop.StoppedError:
        print(f"Stopped and saved. Continue with: {command_again()}")
        return INTERRUPTED
    print(text)
    return 0
