"""The race: a drone, a track and its rules as three pure functions.

Read in this order. ``track`` has the gates and their frames; ``step`` what a race consists of (its
choices, numbers and state) and one ``Step`` of it; ``rules``, ``rewards`` and ``observations`` the
tables of functions of a ``Step``: ``TERMINATIONS``, ``REWARDS`` and ``OBSERVATIONS``;
``environment`` simulates a step and calls them. These six are the race. Next to them, ``starts``
and ``episode`` say how an episode begins, ``laps`` times laps by the exact rules, ``layout`` has
the fields of an observation in files, and ``random_track`` and ``recorded_starts`` make tracks and
starts.
"""
