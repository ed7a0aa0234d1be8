"""Vehicle models with a quaternion in place of Euler angles, which are singular at pitch 90 deg."""

import dataclasses
import functools
import math
from typing import Any

from quadjax.core import quaternion
from quadjax.core.trigonometry import arctan2
from quadjax.vehicle.protocol import Constants, Motion, State, VehicleModel


@functools.cache
def with_quaternions(model: VehicleModel) -> VehicleModel:
    """The model with a quaternion in its state's field ``euler``, so that any attitude is valid.

    For models whose state has the field ``euler`` and whose equations use it only through
    ``quadjax.core.frames``. Each step ends with a quaternion of length one.
    """

    def of(motion: Motion) -> Motion:
        return motion.replace(euler=quaternion.of_euler(motion.euler))

    def start(c: Constants, motion: Motion, *drawn: Any) -> State:
        return model.start(c, of(motion), *drawn)

    return dataclasses.replace(
        model,
        start=start,
        hover=lambda c, motion: model.hover(c, of(motion)),
        euler=lambda state: quaternion.to_euler(state.euler, arctan2),
        wrap=lambda state: state.replace(euler=quaternion.normalized(state.euler)),
        pitch_limit=math.inf,
    )
