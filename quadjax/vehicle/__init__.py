"""Vehicle models: rigid bodies with forces, their constants, and what belongs to a drone.

Read in this order. ``protocol`` has ``VehicleModel``, the one rigid body; ``rigid_body`` its state;
``constants`` their declaration. ``motor``, ``rate`` and ``racing`` are the models, ``registry`` has
them by name. ``residual`` are networks that correct forces and moments, ``battery`` limits
propeller speeds, ``estimator`` estimates disturbances on board. ``airframe``, ``vehicle_file`` and
``summary`` make, read and describe constants. Frames, vectors and integrators are in
``quadjax.core``.
"""
