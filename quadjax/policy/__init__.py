"""Policies: the file, and inference from it."""
