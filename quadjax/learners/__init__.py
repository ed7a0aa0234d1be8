"""Learners: networks, the common training loop, and one module for each learner.

Read in this order. ``networks`` has the Flax module of policy and value; ``state`` the ``Task`` of
a learner, which vectorizes an environment of one agent, and the state of a run; ``learner`` the
base class; ``rollout`` what learners share; ``ppo`` and ``shac`` the update of each; ``schedules``
the ``Training``, a learner with its task and the schedules of their numbers; ``loop`` repeats its
update in compiled chunks, ``parallel`` spreads it over devices. A learner takes any
``quadjax.core.environment.Environment``; nothing here depends on drones. ``Network.normalize``
applies to the race: ``train`` ignores it, ``quadjax.training`` applies it.
"""
