"""The race in other projects' interfaces: Gymnasium, gymnax and Stable-Baselines3."""
