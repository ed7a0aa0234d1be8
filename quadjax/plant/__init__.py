"""Plants, simulated drones: unmodeled physics, sensors, estimator, inner loop."""
