"""Vehicle models for the tests of configs."""

from quadjax.vehicle.rate import Rate


class NoThrust(Rate):
    uses_start_thrust = False


class NoRatio(Rate):
    def thrust_to_weight(self, c):
        return None


NO_THRUST, NO_RATIO = NoThrust(), NoRatio()
