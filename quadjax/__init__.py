"""quadjax: time-optimal quadcopter racing policies, from simulation to fixed-point C."""

__version__ = "0.1.0"
