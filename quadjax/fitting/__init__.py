"""From flight logs to a model: identification, residual networks, disturbance estimation."""
