"""Vehicle models for the tests of configs."""

import jax

from quadjax.vehicle.constants import constant
from quadjax.vehicle.rate import Rate, RateConstants


class Winged(RateConstants):
    d_x: jax.Array = constant("1/s", "wings")


class OwnGroup(Rate):
    constants = Winged


class NoThrust(Rate):
    uses_start_thrust = False


class NoRatio(Rate):
    def thrust_to_weight(self, c):
        return None


OWN_GROUP, NO_THRUST, NO_RATIO = OwnGroup(), NoThrust(), NoRatio()
