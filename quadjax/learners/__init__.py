"""Learners: networks, the common training loop, and one package for each learner.

A learner takes any ``quadjax.core.environment.Environment``; nothing here depends on drones.
``Network.normalize`` is of the race: ``train`` ignores it, ``quadjax.training`` applies it.
"""
