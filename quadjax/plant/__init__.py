"""The stand-in plant: unmodeled physics, sensors, estimator, inner loop."""
