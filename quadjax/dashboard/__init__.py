"""Data of the pages: flights of any source."""
