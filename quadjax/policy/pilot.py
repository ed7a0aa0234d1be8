"""A policy in a race: the race in the policy's scaling, and timed laps.

A race scales actions and observations by its own vehicle's ranges, unless it has the ``scales`` of
a policy: then the policy commands the rpm (or rates and thrust) of its file for any limits of the
vehicle, and observes in the scaling that it was trained with, disturbances too. A training that
starts from a policy converts its layers instead, to have the whole range of the race.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import ArrayLike

from quadjax.core.errors import InputError, warn
from quadjax.policy.file import Policy
from quadjax.policy.inference import PolicyParams, act_sampled
from quadjax.policy.network_files import Layers
from quadjax.race.environment import Race
from quadjax.race.laps import Actor, Laps, Trace, fly_laps
from quadjax.race.layout import LAST_ACTION, Layout, ObservedField
from quadjax.race.observation_config import NONE, Observation
from quadjax.race.observations import HIGHEST_RPM, command_range, fields_of
from quadjax.race.types import PolicyRanges, RaceParams
from quadjax.vehicle.battery import LOWEST
from quadjax.vehicle.protocol import VehicleModel

Ranges = tuple[np.ndarray, np.ndarray]  # lowest and highest


class Pilot(struct.PyTreeNode):
    """A policy, and how it flies."""

    policy: PolicyParams
    noise: jax.Array  # () 1 for sampled actions, 0 for the mean: one compilation for both


def adapt_race(
    environment: Race, params: RaceParams, policy: Policy, name: str = "policy"
) -> tuple[Race, RaceParams]:
    """The race with the observation and the scaling that a policy was trained with.

    It has the policy's fields in the policy's order, and the ranges of its file; for what has none
    there, those of the policy's commands, or of the race. Commands are clipped to the limits of the
    vehicle, but the last action is observed as the policy gave it, as in the exported C. The source
    of the disturbance (ground truth, estimated or none) is that of the race.

    Args:
        environment: the race.
        params: its numbers.
        policy: the policy.
        name: its file, for messages.

    Raises:
        InputError: the policy is for another vehicle, or observes a field that the race lacks.
    """
    if policy.vehicle != environment.model.name:
        raise InputError(
            f"{name}: a policy for vehicle.model={policy.vehicle}, the race has vehicle.model="
            f"{environment.model.name}, allowed: a race of {policy.vehicle}, such as the policy's "
            "own"
        )
    if len(policy.command_low) != environment.model.action_size:
        raise InputError(
            f"{name}: commands {len(policy.command_low)} numbers, the vehicle takes "
            f"{environment.model.action_size}"
        )
    layout = _arranged(environment.layout, policy.layout, environment.model, name)
    own = layout.with_spans(environment.model, params)
    spans: list[tuple[float, float]] = []
    for here, there in zip(own.fields, policy.layout.fields, strict=True):
        spans += there.span or _span_without(environment.model, here, policy)
    low, high = (jnp.asarray(ends, jnp.float32) for ends in zip(*spans, strict=True))
    least, most = (jnp.asarray(x, jnp.float32) for x in (policy.command_low, policy.command_high))
    ranges = PolicyRanges(observed=(low, high), commanded=(least, most))
    return dataclasses.replace(environment, layout=layout), params.replace(ranges=ranges)


def _span_without(
    model: VehicleModel, field: ObservedField, policy: Policy
) -> Sequence[tuple[float, float]]:
    """The ranges of a field of the race for a policy whose file has none."""
    ends = list(zip(policy.command_low.tolist(), policy.command_high.tolist(), strict=True))
    if field.name in (model.actuators.name, LAST_ACTION):
        return ends[-field.size :]
    if field.name == HIGHEST_RPM:
        return [(LOWEST * ends[0][1], ends[0][1])]
    return field.span or [(-1.0, 1.0)] * field.size


def _arranged(layout: Layout, wanted: Layout, model: VehicleModel, name: str) -> Layout:
    """The layout of a race with the fields of a policy's layout, in its order."""
    none = Observation(disturbance=NONE, highest_rpm=NONE)  # full speed without a battery
    fields = dict(fields_of(model, none))
    if model.actuators.name not in layout:  # of a drone that does not measure them
        del fields[model.actuators.name]
    fields |= {field.name: field for field in layout.fields}
    for field in wanted.fields:
        if field.name not in fields or fields[field.name].size != field.size:
            raise InputError(
                f"{name}: observes {field.name!r} ({field.size}), which the race lacks; "
                f"it has {', '.join(f'{f.name} ({f.size})' for f in layout.fields)}"
            )
    return Layout(tuple(fields[field.name] for field in wanted.fields))


def command_ranges(environment: Race, params: RaceParams) -> Ranges:
    """Lowest and highest command (actions,) of the policy or, without one, of the vehicle."""
    ends = command_range(environment.model, params)
    low, high = (np.array([float(x) for x in jax.tree.leaves(end)]) for end in ends)
    return low, high


def make_pilot(policy: Policy, deterministic: bool) -> Pilot:
    """A policy that flies the mean of its actions or samples, in the race of ``adapt_race``."""
    return Pilot(policy.on_device(), jnp.float32(not deterministic))


def in_scaling_of(
    environment: Race, params: RaceParams, policy: Policy, name: str = "policy"
) -> Policy:
    """A policy with other layers for the scaling of a race, in which it commands the same.

    Only what exceeds the limits of its file differs where those of the race are wider, of which
    there is a warning: the layers have no limits of their own.

    Args:
        environment: the race, which has the fields of the policy in the same order.
        params: its numbers.
        policy: the policy.
        name: its file, for messages.

    Raises:
        InputError: another scaling for a network of the user's own.
    """
    limits, own = (
        command_ranges(environment, params),
        _rounded(policy.command_low, policy.command_high),
    )
    layout = environment.layout.with_spans(environment.model, params)
    observed, commanded = _observation_scale(layout, policy.layout), _affine_to(own, limits)
    if all(np.all(x == 1.0) and np.all(offset == 0.0) for x, offset in (observed, commanded)):
        return policy
    pair = " to ".join(f"{x.tolist()}" for x in own), " to ".join(f"{x.tolist()}" for x in limits)
    if policy.own is not None:
        raise InputError(
            f"{name}: commands {pair[0]}, the race {pair[1]}; allowed with network.module: the "
            "command range and the observation ranges of the training"
        )
    if np.any(limits[0] < own[0]) or np.any(limits[1] > own[1]):
        warn(f"{name}: commands {pair[0]}, and may exceed it in this race of {pair[1]}")
    actor = _converted(policy.layers, *observed)
    kernel, bias = actor[-1]
    return dataclasses.replace(
        policy,
        layers=(*actor[:-1], (kernel * commanded[0], bias * commanded[0] + commanded[1])),
        value=policy.value and _converted(policy.value, *observed),
        log_std=policy.log_std + np.log(commanded[0]),
        command_low=limits[0],
        command_high=limits[1],
        layout=layout,
    )


def _converted(layers: Layers, scale: np.ndarray, offset: np.ndarray) -> Layers:
    """Layers for inputs ``x`` that give what the layers give for ``scale * x + offset``."""
    (kernel, bias), *rest = layers
    return ((scale[:, None] * kernel, bias + offset @ kernel), *rest)


def _observation_scale(environment: Layout, training: Layout) -> Ranges:
    """Scale and offset from what an environment shows to what a policy was trained with."""
    scale, offset = np.ones(training.size), np.zeros(training.size)
    for field in training.fields:
        span, training_span = environment[field.name].span, field.span
        if span is None or training_span is None:
            continue
        here, there = _rounded(*np.transpose(span)), _rounded(*np.transpose(training_span))
        columns = training.slice(field.name)
        scale[columns], offset[columns] = _affine_to(here, there)
    return scale, offset


def _rounded(low: ArrayLike, high: ArrayLike) -> Ranges:
    """A range with ends that are rounded to float32."""
    return np.asarray(low, np.float32).astype(float), np.asarray(high, np.float32).astype(float)


def _affine_to(source: Ranges, target: Ranges) -> Ranges:
    """Scale and offset from numbers in [-1, 1] over one range to those over another.

    They are one and zero for equal ranges, and both zero where only the other one has no width.
    """
    (low, high), (to_low, to_high) = source, target
    width = np.where(to_high == to_low, np.inf, to_high - to_low)
    scale = np.where((low == to_low) & (high == to_high), 1.0, (high - low) / width)
    return scale, (high + low - to_high - to_low) / width


def act(pilot: Pilot, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The action (actions,) for an observation (k,), with normal ``noise``."""
    return act_sampled(pilot.policy, observation, pilot.noise * noise)


def fly_policy(
    environment: Race,
    params: RaceParams,
    policy: Policy,
    *,
    deterministic: bool = False,
    seed: int = 0,
    actor: Actor = act,
    name: str = "policy",
    **flight: Any,
) -> tuple[Laps, Trace | None]:
    """Time a policy's laps, with the observation that it was trained with.

    Args:
        environment: the race.
        params: its numbers.
        policy: the policy.
        deterministic: fly the mean rather than samples.
        seed: of the noise, the disturbances and the starts.
        actor: ``(pilot, observation, noise) -> action``, which computes the commands; static.
        name: the policy's file, for messages.
        flight: further arguments of ``fly_laps``.

    Raises:
        InputError: the policy does not fit the vehicle.
    """
    environment, params = adapt_race(environment, params, policy, name)
    pilot = make_pilot(policy, deterministic)
    return fly_laps(environment, params, actor, pilot, jax.random.key(seed), **flight)
