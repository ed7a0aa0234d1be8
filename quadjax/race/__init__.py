"""The task: gates and track, observation, reward, termination, reset, and their environment."""
