"""Sweeps over a training config: search spaces, studies, workers and what came of them."""
