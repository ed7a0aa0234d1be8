"""The reference of the config keys: complete, and every key is described."""

import pytest

from quadjax.config.reference import describe, markdown, sections_of, training_sections
from quadjax.fitting.config import FitConfig
from quadjax.plant.config import PlantConfig
from quadjax.sweeps.schema import Range, SweepFile

SCHEMAS = {
    "training": training_sections,
    "fit": lambda: sections_of(FitConfig, "The fit"),
    "plant": lambda: sections_of(PlantConfig, "The plant"),
    "sweep": lambda: [*sections_of(SweepFile, "The sweep"), ("space", describe(Range))],
}


@pytest.mark.parametrize("name", SCHEMAS)
def test_every_key_has_a_description(name):
    keys = [info for _, keys in SCHEMAS[name]() for info in keys]
    assert len(keys) > 20
    assert not [info.key for info in keys if not info.description.strip()]


def test_a_page_lists_every_key_once():
    text = markdown("Fit config keys", sections_of(FitConfig, "The fit"))
    for info in describe(FitConfig):
        assert text.count(f"| `{info.key}` |") == 1
    assert "## The fit\n" in text and "## `logs.units`\n" in text
