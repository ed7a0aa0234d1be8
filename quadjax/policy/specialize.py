"""A policy for one drone, from one that observes the drone's constants."""

import dataclasses

import numpy as np

from quadjax.config.assembly import race_of
from quadjax.config.schema import Config, Randomization
from quadjax.core.errors import InputError
from quadjax.policy.file import Layers, Policy
from quadjax.race.layout import Layout
from quadjax.race.observations import CONSTANTS
from quadjax.vehicle.constants import values_of

ROUNDING = 1e-6  # relative, of the constants in single precision


def specialize(policy: Policy, config: Config, name: str = "policy") -> Policy:
    """The policy with the constants of a drone in place of their observation.

    The constants enter the bias of the first layer, of the critic too. The policy then has no such
    field, and is exported and fine-tuned as any other.

    Args:
        policy: a policy that observes ``constants``.
        config: the race with that drone.
        name: the policy's file, for messages.

    Raises:
        InputError: the policy does not observe constants, or is for another vehicle model.
    """
    values, low, high = _constants(policy, config, name)
    wide = np.where(high > low, high - low, np.inf)
    seen = (2.0 * np.array(list(values.values())) - low - high) / wide
    columns = policy.layout.slice(CONSTANTS)
    race = config.replace(
        observation=config.observation.replace(constants=False), randomization=Randomization()
    )
    return dataclasses.replace(
        policy,
        layers=_folded(policy.layers, columns, seen),
        value=policy.value and _folded(policy.value, columns, seen),
        layout=Layout(tuple(each for each in policy.layout.fields if each.name != CONSTANTS)),
        source=policy.source | {"vehicle": config.vehicle.name},
        config=race.model_dump(mode="json", by_alias=True),
    )


def outside(policy: Policy, config: Config, name: str = "policy") -> list[str]:
    """The drone's constants that are outside the range of the policy's training, by name.

    None for a policy that was trained on a population, whose range is not known. The arguments are
    those of ``specialize``.
    """
    values, low, high = _constants(policy, config, name)
    if (policy.config or {}).get("randomization", {}).get("population") is not None:
        return []
    slack = ROUNDING * np.maximum(np.abs(low), np.abs(high))
    ends = zip(values.items(), low - slack, high + slack, strict=True)
    return [key for (key, value), lowest, highest in ends if not lowest <= value <= highest]


def _constants(
    policy: Policy, config: Config, name: str
) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """The drone's constants by name, and what the policy observes as -1 and 1."""
    if CONSTANTS not in policy.layout:
        raise InputError(
            f"{name}: does not observe constants, allowed: a policy that was trained with "
            "observation.constants=true"
        )
    choices, params = race_of(config)
    field, model = policy.layout[CONSTANTS], choices.model
    if (policy.vehicle, field.size) != (model.name, len(model.constant_names)):
        raise InputError(
            f"{name}: a policy for the {policy.vehicle} vehicle; vehicle.model of the config is "
            f"{model.name}"
        )
    values = {key: float(x) for key, x in values_of(params.vehicle.constants).items()}
    low, high = np.asarray(field.span, np.float64).T
    return values, low, high


def _folded(layers: Layers, columns: slice, inputs: np.ndarray) -> Layers:
    """The layers without some inputs, whose numbers are known."""
    kernel, bias = layers[0]
    moved = bias + (inputs @ kernel[columns].astype(np.float64)).astype(bias.dtype)
    return ((np.delete(kernel, columns, axis=0), moved), *layers[1:])
