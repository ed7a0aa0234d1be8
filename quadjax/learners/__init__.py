"""Learners: networks, the common training loop, and one module for each learner.

Read in this order. ``networks`` has the Flax module of policy and value; ``state`` the state of a
run; ``rollout`` what learners share, of a ``Task``; ``ppo`` and ``shac`` one update of each;
``loop`` repeats it in compiled chunks. ``schedules`` change numbers of a run, ``parallel`` spreads
it over devices, ``section`` is the base class of hyperparameters. A learner takes any
``quadjax.core.environment.Environment``; nothing here depends on drones. ``Network.normalize``
applies to the race: ``train`` ignores it, ``quadjax.training`` applies it.
"""
