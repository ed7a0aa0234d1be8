"""A flight log through a policy and a model: laps, commands, and predictions of the motion."""
