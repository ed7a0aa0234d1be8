"""Configs: declared keys, loading, checks, and the race of a config.

A config's way to the compiled step, in this order. ``loading.load_config`` finds the files;
``layers`` puts them into the order of their merge (``core.yaml_files`` reads and merges them);
``scales`` replaces numbers in units of the race by plain ones; ``schema.Config`` declares the keys
or imports the sections that do, from ``race``, ``learners`` and ``vehicle`` (``core.sections``
validates each field); ``checks`` rejects combinations of keys. ``assembly`` gives the environment
of the race, which is static, and every number in it; ``training.build`` makes the learner of both.
``reference`` prints a config with the description of each key.
"""
