"""The race: a drone, a track and its rules as three pure functions of one drone.

Read in this order. ``track`` has the gates and their frames; ``types`` the numbers and the
state of a race, and one ``Step`` of it; ``rules`` and ``rewards`` the tables of functions of a
``Step``, ``TERMINATIONS`` and ``REWARDS``; ``layout`` what an ``ObservedField`` is (its value and
its scale), and how a layout of fields gives the inputs of a network; ``observations`` the table of
fields, ``fields_of``; ``environment.Race`` simulates a step and calls them.
These seven are the race. Next to them, ``draws`` and ``episode`` say how an episode begins,
``laps`` times laps by the exact rules, and ``random_track`` makes tracks.
"""
