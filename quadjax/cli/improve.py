"""``quadjax improve``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import command_again, steps
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.studies.improve.run import Report, Setting

FLIGHTS = Group("Flights on the plant", sort_key=2)
Rounds = Annotated[int, Parameter(converter=opt.whole(1, 100), group=FLIGHTS)]
Plants = Annotated[int, Parameter(converter=opt.whole(1, 1000), group=FLIGHTS)]
Check = Annotated[int, Parameter(converter=opt.whole(0, 10_000), group=FLIGHTS)]


def improve(
    config: opt.Config,
    /,
    *overrides: opt.Overrides,
    policy: opt.PolicyFile,
    steps_: Annotated[int | None, Parameter(name="--steps", converter=opt.whole(1, 10**9))] = None,
    fit: opt.FitConfig | None = None,
    allow_code: opt.AllowCode = False,
    logs: Annotated[list[str] | None, Parameter(consume_multiple=True, metavar="FILE ...")] = None,
    rounds: Rounds | None = None,
    flights: Annotated[opt.Runs | None, Parameter(group=FLIGHTS)] = None,
    laps: Annotated[opt.Laps | None, Parameter(group=FLIGHTS)] = None,
    plant: Annotated[opt.PlantConfig | None, Parameter(group=FLIGHTS)] = None,
    plant_seed: Annotated[opt.Seed | None, Parameter(group=FLIGHTS)] = None,
    plants: Plants | None = None,
    seed: Annotated[opt.Seed | None, Parameter(group=FLIGHTS)] = None,
    check: Check | None = None,
    reference: Annotated[opt.Flag, Parameter(group=FLIGHTS)] = False,
    output: opt.Folder = Path("runs/improve"),
    overwrite: opt.Flag = False,
) -> int:
    """Improve a policy by its own flights: fly, refit the model, fine-tune, repeat.

    CONFIG is the race in which the policy was trained. The flights are on the
    stand-in plant, of which only the logs are read. A model that does not predict
    held-out flights better than the present one is rejected. With --plants the same
    is done on several drawn plants, each time from the policy of the file. DIR gets
    the logs, the model and the training of each round, policy.npz and table.txt.
    The same command resumes after a stop. With --logs it reads real logs instead:
    it prints what they change in the model and fine-tunes the policy, without
    flying.

    Example: quadjax improve e2e --policy e2e_nominal --rounds 3

    Args:
        policy: Policy file with its critic, or a shipped one's name.
        steps_: Of each fine-tuning (default: 1000000).
        logs: Real logs, in place of flights.
        rounds: Of flying and learning (default: 3).
        flights: In each round (default: 2).
        laps: Of each flight (default: 6).
        plant_seed: Of the plant's constants.
        plants: Number of plants, with seeds from --plant-seed on.
        seed: Of batteries, gusts and sensors (default: 0).
        check: Flights that evaluate the first and the last policy (default: 10).
        reference: Also fine-tune the first policy on the plant's own numbers, for
            comparison.
        output: Folder of the results.
        overwrite: Replace earlier results.
    """
    numbers: dict[str, Any] = {
        **{"rounds": rounds, "flights": flights, "laps": laps, "check": check, "seed": seed},
        "reference": reference or None,
    }
    of_plant = {"plant": plant, "plant-seed": plant_seed, "plants": plants}
    for name, value in {**numbers, **of_plant}.items():
        if logs and value is not None:
            raise InputError(f"--logs and --{name} exclude each other")
    if reference and check == 0:
        raise InputError("--reference needs flights to compare: --check of at least 1")
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.compilation_cache import enable_compilation_cache
        from quadjax.core.folders import claim, remove_files
        from quadjax.fitting.config import load_fit_config
        from quadjax.fitting.flight_log import find_logs
        from quadjax.learners.devices import prepare_devices
        from quadjax.plant.config import load_plant_config
        from quadjax.studies.improve import run

    model = load_fit_config(fit or "improve", allow_code=allow_code)
    drone = None
    if not logs:
        drone = load_plant_config(plant or "standin")
        if plant_seed is not None:
            drone = drone.replace(constants=drone.constants.replace(seed=plant_seed))
    files = find_logs(model.logs.replace(files=tuple(logs)), Path()) if logs else []
    numbers = {key: value for key, value in numbers.items() if value is not None}
    numbers |= {} if steps_ is None else {"steps": steps_}
    race = load_config(config, overrides)
    setting = run.Setting(race, policy, model, drone, tuple(files), **numbers)
    enable_compilation_cache()
    prepare_devices(race.run.devices)
    run.check_setting(setting)
    try:
        with claim(output, run.KIND, run.FILES, overwrite), steps() as report:
            if overwrite:
                remove_files(output, run.FILES)
            run.start(setting, output)
            text = _run(setting, plants, output, report)
    except run.StoppedError:
        print(f"Stopped and saved. Continue with: {command_again()}")
        return INTERRUPTED
    print(text)
    return 0


def _run(setting: "Setting", plants: int | None, folder: Path, report: "Report") -> str:
    """The rounds on one plant or several, or the real logs, and the text of the result."""
    from quadjax.core.files import write_text
    from quadjax.studies.improve import check, run
    from quadjax.studies.improve.model import Model, constant_lines, error_lines
    from quadjax.studies.improve.rounds import rounds_table

    if setting.logs:
        learned = run.learn(setting, folder, report)
        lines = [*constant_lines(Model.of(setting.race), learned.model), "", *error_lines(learned)]
        refused = learned.refused
        lines += ["", f"rejected: {refused}" if refused else "accepted; policy.npz"]
        text = "\n".join(lines)
    elif plants:
        text = check.plants_table(check.improve_plants(setting, folder, plants, report))
    else:
        rounds = run.improve(setting, folder, report)
        text = rounds_table(rounds, check.checked(setting, rounds, folder, report))
    write_text(folder / "table.txt", text + "\n")
    return text
