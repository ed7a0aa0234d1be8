"""Fly, refit, fine-tune: rounds on the stand-in plant, or one on real logs.

A step whose result is in the folder is not repeated, so the same command resumes after a stop.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json, write_text
from quadjax.core.markdown import table
from quadjax.fitting.config import FitConfig
from quadjax.fitting.flight_log import FlightLog, read_log
from quadjax.fitting.report import PATTERNS as FIT_FILES
from quadjax.flights.files import save
from quadjax.improve.model import Model, Refit, check_speeds, constant_lines, error_lines, refit
from quadjax.improve.setting import Flown, Round, Setting, start_of, tuning_config
from quadjax.improve.states import margin_of, states_of_logs
from quadjax.plant.flights import fly_plan
from quadjax.plant.logs import write_logs
from quadjax.plant.races import plan_race
from quadjax.policy.file import Policy
from quadjax.race.rules import HIT_A_GATE
from quadjax.training.result import is_finished, read_summary
from quadjax.training.run import train

KIND = "improvement"
FILES = (
    *("improve.json", "table.txt", "policy.npz", "round_*", "check_*.json"),
    *("model.json", "states.npz", "training", *FIT_FILES),  # of real logs
)
SHORT = 0.1  # s more than logs.min_seconds
CHECK_SEED = 10_000  # of flights that are learned from by no round
COLUMNS = (
    *("round", "finished", "time of all laps, s", "flight, s", "model", "error", "computing, s"),
)
Report = Callable[[str], None]


class StoppedError(Exception):
    """The user stopped a training, which is saved."""


def improve(setting: Setting, folder: Path, report: Report) -> str:
    """All rounds, or the fit of real logs; returns the text that ``table.txt`` has.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    if setting.logs:
        learned = learn(setting, folder, report)
        refused = learned.refused
        lines = [*constant_lines(Model.of(setting.race), learned.model), "", *error_lines(learned)]
        text = "\n".join(
            [*lines, "", f"rejected: {refused}" if refused else "accepted; policy.npz"]
        )
    else:
        rounds = fly_rounds(setting, folder, report)
        check = checked(setting, len(rounds), folder, report) if setting.check else {}
        text = rounds_table(rounds, check)
    write_text(folder / "table.txt", text + "\n")
    return text


def learn(setting: Setting, folder: Path, report: Report) -> Refit:
    """Fit real logs, and fine-tune the policy on the model if it is accepted.

    Raises:
        StoppedError: a training was interrupted; it is saved.
        InputError: logs or a policy that cannot be used.
    """
    before, path = start_of(setting), folder / "model.json"
    logs = [read_log(file, setting.fit.logs) for file in setting.logs]
    if not path.exists():
        check_speeds(logs, before.model, setting.fit.logs.max_scale_error)
    found = _refit(setting, setting.logs, setting.logs, before.model, folder, report)
    if not found.refused:
        after = dataclasses.replace(before, model=found.model)
        Policy.load(tune(setting, after, logs, folder, report)).save(folder / "policy.npz")
    return found


def fly_rounds(setting: Setting, folder: Path, report: Report) -> list[Round]:
    """The rounds on the plant; errors as of ``improve``."""
    rounds, state = [], start_of(setting)
    for number in range(1, setting.rounds + 1):
        place = folder / f"round_{number}"
        place.mkdir(exist_ok=True)

        def say(line: str, number: int = number) -> None:
            report(f"round {number}: {line}")

        state = _round(setting, number, place, state, say)
        rounds.append(state)
        Policy.load(state.policy).save(folder / "policy.npz")
    return rounds


def _round(setting: Setting, number: int, folder: Path, before: Round, report: Report) -> Round:
    """One round: its flights, its model, its training."""
    name = f"round_{number}"
    flown, recent = _flights(setting, name, number, folder, before, report)
    files = (*before.logs, *recent)
    found, error = _model(setting, files, recent, before.model, folder, report)
    logs = [read_log(file, setting.fit.logs) for file in files]
    own = [log for log in logs if Path(log.path) in recent]
    hit = [f"{name}_{run}" for run, why in enumerate(flown.crashes) if why == HIT_A_GATE]
    race = setting.race.at("reward.gate_edge_margin", before.margin)
    margin = margin_of(race, own, hit, len(hit))
    accepted = found is not None and not found.refused
    model = found.model if found is not None and accepted else before.model
    seconds = found.seconds if found else 0.0
    after = Round(before.policy, model, margin, files, flown, found, error, seconds, len(recent))
    if accepted or margin > before.margin:
        policy = tune(setting, after, logs, folder, report)
        seconds += float(read_summary(folder / "training")["seconds"])
        after = dataclasses.replace(after, policy=policy, computing=seconds)
    return after


def _flights(
    setting: Setting, name: str, number: int, folder: Path, before: Round, report: Report
) -> tuple[Flown, list[Path]]:
    """The flights of a round, and the logs that a fit accepts: not those of early crashes."""
    path, logs = folder / "flights.json", folder / "logs"
    if not path.exists():
        report("flying")
        logs.mkdir(exist_ok=True)
        flown = fly_and_log(setting, before, name, logs, setting.seed + number, report)
        write_json(path, dataclasses.asdict(flown))
    flown = Flown(**read_json(path))
    shortest = setting.fit.logs.min_seconds + SHORT
    files = [logs / f"{name}_{run}.csv" for run in range(len(flown.seconds))]
    long = [file for file, s in zip(files, flown.seconds, strict=True) if s > shortest]
    return flown, [file for file in long if _is_accepted(file, setting.fit)]


def fly_and_log(
    setting: Setting, state: Round, name: str, folder: Path, seed: int, report: Report
) -> Flown:
    """Fly a policy's mean action on the plant and write the logs ``folder/NAME_RUN.csv``."""
    assert setting.plant is not None
    plant = setting.plant.replace(control_rate=setting.plant.sample_rate)
    race, policy = state.model.race(setting.race), Policy.load(state.policy)
    laps, runs = setting.laps, setting.flights
    plan = plan_race(
        race, plant, policy, str(state.policy), lap_count=laps, runs=runs, recorded=runs
    )
    written = write_logs({name: plan}, folder, seed, report)
    totals = [log.total if np.isfinite(log.total) else None for log in written]
    return Flown([log.seconds for log in written], totals, [log.crash for log in written])


def _is_accepted(file: Path, fit: FitConfig) -> bool:
    """Whether the checks of a log accept it; columns of short logs may seem inconsistent."""
    try:
        read_log(file, fit.logs)
    except InputError:
        return False
    return True


def _model(
    setting: Setting,
    files: Sequence[Path],
    recent: Sequence[Path],
    present: Model,
    folder: Path,
    report: Report,
) -> tuple[Refit | None, str]:
    """The model of a round, or why the logs do not give one."""
    refused = folder / "no_model.txt"
    if not refused.exists():
        try:
            if not recent:
                raise InputError(
                    "every log of the round is rejected or shorter than logs.min_seconds"
                )
            return _refit(setting, files, recent, present, folder, report), ""
        except InputError as error:
            write_text(refused, f"{error}\n")
    return None, refused.read_text(encoding="utf-8").strip()


def _refit(
    setting: Setting,
    files: Sequence[Path],
    recent: Sequence[Path],
    present: Model,
    folder: Path,
    report: Report,
) -> Refit:
    """The refitted model of ``folder/model.json``, which is computed where it does not exist."""
    path = folder / "model.json"
    if not path.exists():
        battery = setting.race.battery
        refit(files, recent, setting.fit, present, folder, report, battery).save(path)
    return Refit.load(path)


def tune(
    setting: Setting, state: Round, logs: Sequence[FlightLog], folder: Path, report: Report
) -> Path:
    """Fine-tune a policy in ``folder/training``; returns the file of its last parameters.

    Where these do not fly, it is the file of the best ones.
    """
    path, place = folder / "states.npz", folder / "training"
    if not path.exists():
        states = states_of_logs(logs, state.model.race(setting.race))
        if states is not None:
            save([states], path)
    if not is_finished(place):
        report("fine-tuning")
        states_file = path if path.exists() else None
        config = tuning_config(
            setting.race, state.model, state.policy, states_file, state.margin, setting.steps
        )
        if not train(config, place, resume=True, progress=False).finished:
            raise StoppedError
    # The best by lap time may pass closer to the edges than the margin asks for.
    flies = read_summary(place)["last_lap_total"] is not None
    return place / ("policy_last.npz" if flies else "policy.npz")


def checked(setting: Setting, rounds: int, folder: Path, report: Report) -> dict[str, Flown]:
    """Flights of the first and the last policy on the plant, which nothing is learned from."""
    found = {}
    names = {"before": (setting.policy, "before")}
    names["after"] = (folder / "policy.npz", f"after_{rounds}")
    for name, (policy, label) in names.items():
        path = folder / f"check_{setting.check}_{label}.json"
        if not path.exists():
            report(f"checking the policy: {label}")
            write_json(path, dataclasses.asdict(fly_checks(setting, policy)))
        found[name] = Flown(**read_json(path))
    return found


def fly_checks(setting: Setting, policy: Path) -> Flown:
    """Results of ``setting.check`` flights of a policy, without logs."""
    assert setting.plant is not None
    network, count, runs = Policy.load(policy), setting.laps, setting.check
    plan = plan_race(
        setting.race, setting.plant, network, str(policy), lap_count=count, runs=runs, recorded=1
    )
    laps = fly_plan(plan, CHECK_SEED + setting.seed).laps
    totals = [float(x) if np.isfinite(x) else None for x in laps.totals]
    return Flown([float(x) for x in np.asarray(laps.seconds)], totals, list(laps.crashes))


def rounds_table(rounds: Sequence[Round], check: dict[str, Flown]) -> str:
    """The rounds as a Markdown table; seconds are summed over the rounds."""
    rows: list[Sequence[str]] = [COLUMNS]
    notes, flight, computing, crashes = [], 0.0, 0.0, 0
    for number, done in enumerate(rounds, start=1):
        assert done.flown is not None
        flight, computing = flight + sum(done.flown.seconds), computing + done.computing
        crashes += sum(map(bool, done.flown.crashes))
        found, state, error = done.found, "none", "-"
        if found is not None:
            state = "rejected" if found.refused else "accepted"
            error = f"{100.0 * found.change:+.0f}%"
        cells = (f"{flight:.0f}", state, error, f"{computing:.0f}")
        rows.append((str(number), *done.flown.cells, *cells))
        out = len(done.flown.totals) - done.fitted
        notes += [f"round {number}: {out} logs left out, too short or rejected"] if out else []
        why = done.error or (found.refused if found else "")
        notes += [f"round {number}: the model is rejected: {why}"] if why else []
    rows += [(f"check, {name}", *flown.cells, "", "", "", "") for name, flown in check.items()]
    return "\n".join([table(rows), "", f"crashes in the rounds: {crashes}", *notes])
