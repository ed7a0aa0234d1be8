"""Timed laps, and the tables, figures and animations made of them."""
