"""The race in other projects' interfaces: Gymnasium and Stable-Baselines3."""
