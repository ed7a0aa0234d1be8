"""Timed laps, and the tables and figures made of them."""
