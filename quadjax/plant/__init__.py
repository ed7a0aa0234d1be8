"""The stand-in plant: what the training model leaves out, sensors, estimator, inner loop."""
