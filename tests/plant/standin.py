"""The stand-in plant with all effects off, and with only some."""

from quadjax.plant.config import NO_EFFECTS, PlantConfig, without_effects

OFF = without_effects(PlantConfig())


def only(**strengths: float) -> PlantConfig:
    return OFF.replace(effects=NO_EFFECTS.replace(**strengths))
