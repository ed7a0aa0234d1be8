"""Fine-tuning of a policy on a refitted model, from the states of its own flights."""

from pathlib import Path

from quadjax.config.schema import Config
from quadjax.studies.improve.model import Model
from quadjax.training.fine_tuning import fine_tuning

EVALUATIONS = 2  # of a fine-tuning


def tuning_config(
    config: Config,
    model: Model,
    policy: Path,
    states: Path | None,
    margin: float,
    steps: int,
) -> Config:
    """The training of one round.

    Args:
        config: of the race in which the policy was trained.
        model: of the drone.
        policy: its file.
        states: file of the states in which a part of the episodes starts; None for none.
        margin: ``reward.gate_edge_margin``, m.
        steps: environment steps.
    """
    own = model.race(fine_tuning(config, policy))
    if own.reward.gate_edge > 0:
        own = own.at("reward.gate_edge_margin", margin)
    run = {"steps": steps, "evaluate_every": max(1, steps // EVALUATIONS)}
    run |= {"start_states": None if states is None else str(states)}
    if states is None:
        run["start_states_part"] = type(own.run)().start_states_part
    return own.replace(run=own.run.replace(**run))
