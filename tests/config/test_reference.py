"""Every key of every config is described."""

import pytest

from quadjax.config.loading import LEARNERS
from quadjax.config.reference import describe
from quadjax.config.schema import Config, Schedule
from quadjax.fitting.config import FitConfig
from quadjax.plant.config import PlantConfig
from quadjax.race.track import GateSection
from quadjax.sweeps.schema import Range, SweepFile

SECTIONS = (Config, *LEARNERS.values(), GateSection, Schedule, FitConfig, PlantConfig)


@pytest.mark.parametrize("schema", [*SECTIONS, SweepFile, Range], ids=lambda x: x.__name__)
def test_every_key_has_a_description(schema):
    keys = describe(schema)
    assert len(keys) > 3
    assert not [info.key for info in keys if not info.description.strip()]
