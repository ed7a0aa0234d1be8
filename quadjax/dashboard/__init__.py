"""Data of the pages: flights of any source, training runs in progress, and sweeps."""
