"""Fine-tuning of a policy on a refitted model, from the states of its own flights."""

from pathlib import Path

from quadjax.config.schema import Config
from quadjax.learners.section import Schedule
from quadjax.studies.improve.model import Model

FIRST_RATE = 0.3  # of the config's learning rates, at the start of a fine-tuning
RATES = ("learning_rate", "critic_learning_rate")
EVALUATIONS = 2  # of a fine-tuning


def at_the_end(config: Config) -> Config:
    """The config without schedules: each number has its last value, learning rates their own."""
    own = config
    for key, schedule in config.schedules.items():
        last = schedule.linear[-1]
        if last != "value" and key.removeprefix("learner.") not in RATES:
            own = own.at(key, last)
    return own.replace(schedules={})


def tuning_config(
    config: Config,
    model: Model,
    policy: Path,
    states: Path | None,
    margin: float,
    steps: int,
) -> Config:
    """The training of one round.

    The learning rates start below those of the config and end at zero. Policy and critic start as
    those of the policy's file.

    Args:
        config: of the race in which the policy was trained.
        model: of the drone.
        policy: its file.
        states: file of the states in which a part of the episodes starts; None for none.
        margin: ``reward.gate_edge_margin``, m.
        steps: environment steps.
    """
    own = model.race(at_the_end(config))
    if own.reward.gate_edge > 0:
        own = own.at("reward.gate_edge_margin", margin)
    rates = [name for name in RATES if name in type(own.learner).model_fields]
    first = {name: FIRST_RATE * getattr(own.learner, name) for name in rates}
    falling = Schedule(linear=("value", 0.0))
    schedules = {f"learner.{name}": falling for name in rates}
    run = {"steps": steps, "evaluate_every": max(1, steps // EVALUATIONS)}
    run |= {"initial_policy": str(policy), "start_states": None if states is None else str(states)}
    if states is None:
        run["start_states_part"] = type(own.run)().start_states_part
    learner = own.learner.replace(**first)
    return own.replace(learner=learner, schedules=schedules, run=own.run.replace(**run))
