"""Proximal policy optimisation (Schulman et al., 2017), wholly inside ``lax.scan``."""
