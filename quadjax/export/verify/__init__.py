"""Verification of an exported folder: build and run it with whatever this machine has."""
