"""A flight log replayed: its laps, a policy's commands in its states, and a model's predictions.

``states`` has the log as states of a model, ``commands`` what the policy commands in them,
``prediction`` the errors of a model, ``report`` the text, numbers and figures.
"""

import dataclasses
from collections.abc import Callable

from quadjax.config.race import build_params, choices_of
from quadjax.config.schema import Config
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import example_state
from quadjax.fitting.flight_log import FlightLog
from quadjax.flights.flight import Flight
from quadjax.flights.gates import REACH
from quadjax.policy.file import Policy
from quadjax.race.track import TrackSection
from quadjax.replay.commands import Commands, policy_commands
from quadjax.replay.prediction import Prediction, predict
from quadjax.replay.states import vehicle_flight


@dataclasses.dataclass(frozen=True)
class Replay:
    """A flight log, and what a policy and a model make of it; without a policy no commands."""

    flight: Flight
    track: TrackSection
    commands: Commands | None
    model: str
    prediction: Prediction
    residual: str | None = None


def replay(
    log: FlightLog,
    track: TrackSection,
    drone: Config,
    race: OwnRace | None,
    policy: Policy | None,
    drive: str | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Replay:
    """Replay a flight.

    Args:
        log: with position and attitude.
        track: that was flown.
        drone: whose vehicle predicts the flight.
        race: the policy's race, on the same track.
        policy: None for the laps and the model alone.
        drive: what drives the model: commands, speeds, or None: commands if the log has them.
        report: called with the progress.

    Raises:
        InputError: a log without a signal that is needed, or shorter than a window; in one line.
    """
    choices, params = choices_of(drone), build_params(drone)
    flight = vehicle_flight(log, choices.model, params.vehicle)
    flight = flight.with_passages(track.gates, REACH, track.closed)
    commands = None
    if race is not None and policy is not None:
        report("commands of the policy")
        own = vehicle_flight(log, race.choices.model, race.params.vehicle)
        own = own.with_passages(track.gates, REACH, track.closed)
        commands = policy_commands(own, race, policy)
    report("predictions of the model")
    example = example_state(choices, params)
    prediction = predict(flight, choices.model, params.vehicle, example, drive)
    return Replay(flight, track, commands, choices.model.name, prediction, drone.vehicle.residual)
