"""Vehicle models for the tests of configs."""

from quadjax.vehicle.rate import Rate


class NoRatio(Rate):
    def thrust_to_weight(self, c):
        return None


NO_RATIO = NoRatio()
