"""Flights: signals over time and passages of gates, from a simulation, a log or a file.

``flight`` has the class, ``gates`` the rule by which a path passes a gate, ``files`` the file
format.
"""

from quadjax.flights.files import load, save
from quadjax.flights.flight import Flight, Signal, fastest, recorded_flights
from quadjax.flights.gates import clearance, passages

__all__ = [
    "Flight",
    "Signal",
    "clearance",
    "fastest",
    "load",
    "passages",
    "recorded_flights",
    "save",
]
