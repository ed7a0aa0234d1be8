"""The stand-in plant with all effects off, and with only some."""

import dataclasses

from quadjax.plant.plant_schema import NO_EFFECTS, PlantConfig
from quadjax.studies.identify import without_effects

OFF = without_effects(PlantConfig())


def only(**strengths: float) -> PlantConfig:
    return dataclasses.replace(OFF, effects=dataclasses.replace(NO_EFFECTS, **strengths))
