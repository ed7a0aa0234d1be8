"""The race: a drone, a track and its rules as three pure functions.

Read in this order. ``track`` has the gates and their frames; ``step`` the types of a race: its
choices, numbers and state, and one ``Step`` of it; ``rules`` and ``rewards`` the tables of
functions of a ``Step``, ``TERMINATIONS`` and ``REWARDS``; ``layout`` what a ``Field`` of an
observation is (its value and its scale), how a layout of fields gives the inputs of a network, and
the history; ``observations`` the table ``OBSERVATIONS`` of fields; ``environment`` simulates a step
and calls them. These seven are the race. Next to them, ``starts`` and ``episode`` say how an
episode begins, ``laps`` times laps by the exact rules, and ``random_track`` makes tracks.
"""
