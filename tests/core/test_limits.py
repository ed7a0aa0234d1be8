"""Every size in every schema has an upper bound, which is stated at the key."""

import importlib
import pkgutil
import types
import typing

import pytest

import quadjax
from quadjax.core.errors import InputError
from quadjax.core.sections import Section, build


def sections() -> list[type[Section]]:
    """Every section of the package."""
    for module in pkgutil.walk_packages(quadjax.__path__, "quadjax."):
        if module.name.split(".")[-1] in ("schema", "config", "hyperparameters", "section"):
            importlib.import_module(module.name)
    found, new = [], [Section]
    while new:
        new = [sub for each in new for sub in each.__subclasses__()]
        found += [each for each in new if each.__module__.startswith("quadjax.")]
    return found


def unbounded(hint, metadata):
    """The numbers, lists and mappings of a type that have no upper bound."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        own = [m for each in arguments[1:] for m in getattr(each, "metadata", [each])]
        return unbounded(arguments[0], own)
    if origin in (typing.Union, types.UnionType):
        return [part for option in arguments for part in unbounded(option, metadata)]
    names = ("le", "lt", "max_length")
    bounds = {name for m in metadata for name in names if getattr(m, name, None) is not None}
    if hint in (int, float):
        return [] if bounds & {"le", "lt"} else [hint.__name__]
    if origin in (tuple, list, dict):
        sized = "max_length" in bounds or (origin is tuple and Ellipsis not in arguments)
        inner = [part for each in arguments for part in unbounded(each, ())]
        return inner if sized else [*inner, origin.__name__]
    return []


def test_all_schemas_are_found():
    names = {section.__name__ for section in sections()}
    assert {"Config", "PPO", "SHAC", "Network", "SweepFile", "FitConfig", "PlantConfig"} <= names


@pytest.mark.parametrize("section", sections(), ids=lambda section: section.__name__)
def test_every_size_has_an_upper_bound(section):
    fields = section.model_fields.items()
    found = {name: unbounded(field.annotation, field.metadata) for name, field in fields}
    assert not {name: parts for name, parts in found.items() if parts}


class Anything(Section):
    """Keys without bounds of their own."""

    text: str = ""
    names: dict[str, str] = {}


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"text": "x" * 1001}, "f: text is 'x+..., allowed: at most 1000 characters"),
        ({"names": {"a": "x" * 9999}}, "f: names.a is 'x+..., allowed: at most 1000 characters"),
    ],
)
def test_texts_are_bounded_in_every_section(tree, message):
    with pytest.raises(InputError, match=message):
        build(Anything, tree, "f")
