"""Vehicle models for the tests of configs."""

import dataclasses

from quadjax.vehicle import rate

OWN_GROUP = dataclasses.replace(rate.MODEL, groups={**rate.MODEL.groups, "wings": ("d_x",)})
NO_THRUST = dataclasses.replace(rate.MODEL, uses_start_thrust=False)
NO_RATIO = dataclasses.replace(rate.MODEL, thrust_to_weight=None)
