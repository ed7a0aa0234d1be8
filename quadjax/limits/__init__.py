"""Time-optimal laps of a vehicle model: best known laps, and lower bounds of the lap time."""
