"""Experiments that use the other packages: E2E against INDI, ablations, identification."""
