"""quadjax: time-optimal quadcopter racing policies, from simulation to fixed-point C."""
