"""A policy that learns from its own flights: logs, a refitted model, and fine-tuning on it."""
