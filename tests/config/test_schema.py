"""Every key of every schema is described, and every size has an upper bound."""

import importlib
import pkgutil

import pytest

import quadjax
from quadjax.config.reference import describe
from quadjax.core.errors import InputError
from quadjax.core.sections import Section, validate

MODULES = ("schema", "config", "ppo", "shac", "section", "schedules", "track", "conditions")


def sections() -> list[type[Section]]:
    """Every section of the package."""
    for module in pkgutil.walk_packages(quadjax.__path__, "quadjax."):
        if module.name.split(".")[-1] in MODULES:
            importlib.import_module(module.name)
    classes, new = [], [Section]
    while new:
        new = [below for section in new for below in section.__subclasses__()]
        classes += [section for section in new if section.__module__.startswith("quadjax.")]
    return classes


def unbounded(name, node):
    """The numbers, lists and mappings of a JSON schema that have no upper bound."""
    wanted = {
        "integer": {"maximum", "exclusiveMaximum"},
        "number": {"maximum", "exclusiveMaximum"},
        "array": {"maxItems"},
        "object": {"maxProperties", "properties"},
    }.get(node.get("type"))
    if wanted and not wanted & node.keys():
        yield name
    inner = [node[key] for key in ("items", "additionalProperties") if key in node]
    for each in [*inner, *node.get("anyOf", ()), *node.get("prefixItems", ())]:
        yield from unbounded(name, each) if isinstance(each, dict) else ()


def test_every_key_is_described_and_every_size_has_an_upper_bound():
    names = {section.__name__ for section in sections()}
    assert {"Config", "PPO", "SHAC", "Network", "SweepFile", "FitConfig", "PlantConfig"} <= names
    for section in sections():
        for name, node in section.model_json_schema()["properties"].items():
            assert not list(unbounded(f"{section.__name__}.{name}", node))
        if section.__module__.rpartition(".")[2] in MODULES:  # of configs, which users write
            assert not [info.key for info in describe(section) if not info.description.strip()]


class Anything(Section):
    """Keys without bounds of their own."""

    names: dict[str, str] = {}


def test_texts_are_bounded_in_every_section():
    with pytest.raises(InputError, match="f: names.a is 'x+..., allowed: at most 1000 characters"):
        validate(Anything, {"names": {"a": "x" * 9999}}, "f")
