"""Physics: frames, forces and moments, motor-level and rate-level models, integrators."""
