"""The race: a drone, a track and its rules as three pure functions of one drone.

Read in this order. ``track`` has the gates and their frames; ``types`` the numbers and the
state of a race, and one ``Step`` of it; ``rules`` and ``rewards`` the tables of functions of a
``Step``, ``TERMINATIONS`` and ``REWARDS``; ``layout`` what an ``ObservedField`` is (its value and
its scale), and how a layout of fields gives the inputs of a network; ``observations`` the table of
fields, ``fields_of``; ``memory`` what a race remembers from one step to the next;
``environment.Race`` simulates a step and calls them. These eight are the race.

Next to them: ``openings`` decides what a step passes and touches, for ``rules``; ``draws`` (the
sections of a config) and ``episode`` say how an episode begins; ``observation_config`` is the
section of a config that chooses the fields; ``laps`` times laps by the exact rules, ``lap_times``
holds the times; ``random_track`` makes tracks, ``legs`` has their straight lines.
"""
