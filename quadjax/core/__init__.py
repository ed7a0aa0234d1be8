"""Code that all packages use.

Numerics: ``vectors``, ``quaternion``, ``frames``, ``trigonometry``, ``gradients``, ``filters``,
``integrators``, ``mlp``, ``materialize``, ``shapes``. ``environment`` is the interface of tasks and
learners. Configs: ``sections``, their fields as arrays in ``traced``, ``yaml_files``,
``yaml_layers``, ``resources``. Files and errors: ``files``, ``folders``, ``errors``, ``imports``,
``interruptions``, ``provenance``; ``forks`` of processes.
"""
