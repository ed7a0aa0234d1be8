"""Time-optimal laps of a vehicle model: best known laps."""
