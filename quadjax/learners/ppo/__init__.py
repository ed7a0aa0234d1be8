"""Proximal policy optimization (Schulman et al., 2017), compiled as one ``lax.scan``."""
