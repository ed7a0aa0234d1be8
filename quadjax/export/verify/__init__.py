"""Verification of an exported folder: build and run it with the tools of this machine."""
