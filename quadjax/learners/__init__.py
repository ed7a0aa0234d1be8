"""Learners: networks, the common training loop, and one package for each learner.

A learner takes any ``quadjax.core.environment.Environment``; nothing here depends on drones.
"""
