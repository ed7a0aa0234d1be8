"""A policy for one drone, from one that observes the drone's constants."""

import dataclasses

import jax
import numpy as np

from quadjax.config.race import race_of
from quadjax.config.schema import Config, Randomization
from quadjax.core.errors import InputError
from quadjax.policy.file import Layers, Policy
from quadjax.race.known_drone import CONSTANTS
from quadjax.race.layout import Layout


def specialize(policy: Policy, config: Config, name: str = "policy") -> Policy:
    """The policy with the constants of a drone in place of their observation.

    The constants enter the bias of the first layer, of the critic too. The policy then has no such
    field, and is exported and fine-tuned as any other.

    Args:
        policy: which observes ``constants``.
        config: of the race with that drone.
        name: the policy's file, for messages.

    Raises:
        InputError: the policy does not observe constants, or is for another vehicle model.
    """
    if CONSTANTS not in policy.layout:
        raise InputError(
            f"{name}: does not observe constants, allowed: a policy that was trained with "
            "observation.constants=true"
        )
    choices, params = race_of(config)
    field = policy.layout[CONSTANTS]
    model = choices.model
    if (policy.vehicle, field.size) != (model.name, len(model.constant_names)):
        raise InputError(
            f"{name}: a policy for the {policy.vehicle} vehicle; vehicle.model of the config is "
            f"{model.name}"
        )
    values = [getattr(params.vehicle.constants, each) for each in model.constant_names]
    low, high = np.asarray(field.span, np.float64).T
    wide = np.where(high > low, high - low, np.inf)
    seen = (2.0 * np.asarray(jax.device_get(values), np.float64) - low - high) / wide
    columns = policy.layout.slice(CONSTANTS)
    own = config.replace(
        observation=config.observation.replace(constants=False), randomization=Randomization()
    )
    return dataclasses.replace(
        policy,
        layers=_folded(policy.layers, columns, seen),
        value=policy.value and _folded(policy.value, columns, seen),
        layout=Layout(tuple(each for each in policy.layout.fields if each.name != CONSTANTS)),
        source=policy.source | {"vehicle": config.vehicle.name},
        config=own.model_dump(mode="json", by_alias=True),
    )


def _folded(layers: Layers, columns: slice, inputs: np.ndarray) -> Layers:
    """The layers without some inputs, whose numbers are known."""
    kernel, bias = layers[0]
    moved = bias + (inputs @ kernel[columns].astype(np.float64)).astype(bias.dtype)
    return ((np.delete(kernel, columns, axis=0), moved), *layers[1:])
