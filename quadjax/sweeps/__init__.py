"""Hyperparameter sweeps: a thin layer over Optuna and an executor (local processes or Ray)."""
