"""A policy that learns from flights: a fit, accepted or rejected, and fine-tuning on it.

``model`` refits the drone's model, ``states`` has what logs tell a training, ``setting`` what is
asked for, ``rounds`` the steps.
"""
