"""Learners: networks, the loop that all share, and one small package for each.

A learner takes any ``quadjax.core.environment.Environment``; nothing here depends on drones.
"""
