"""The reference of every config key, from the declarations, and configs with comments."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from pydantic import BaseModel

from quadjax.config.scales import Location, WithUnit
from quadjax.config.schema import Config
from quadjax.core.section_keys import is_section
from quadjax.core.sections import Section
from quadjax.core.yaml_files import to_yaml

BOUNDS = {  # of a JSON schema
    "minimum": "at least {}",
    "exclusiveMinimum": "above {}",
    "maximum": "at most {}",
    "exclusiveMaximum": "below {}",
    "minItems": "at least {} of them",
    "maxItems": "at most {} of them",
    "maxProperties": "at most {} of them",
    "pattern": "matching {}",
}
KINDS = {"boolean": "true or false", "integer": "a whole number", "number": "a number"}
KINDS |= {"string": "text", "null": "null", "object": "a mapping", "array": "a list"}


class KeyInfo(NamedTuple):
    """One key of a config: dotted name, values it takes, default and description."""

    key: str
    allowed: str
    default: object
    description: str


def describe(schema: type[BaseModel], prefix: str = "") -> list[KeyInfo]:
    """Every key of a section and of those in it, in order, for help and reference pages."""
    keys: list[KeyInfo] = []
    document = schema.model_json_schema()
    for name, field in schema.model_fields.items():
        key = f"{prefix}{field.alias or name}"
        if is_section(field.annotation):
            keys += describe(field.annotation, f"{key}.")
        else:
            default = None if field.is_required() else field.get_default(call_default_factory=True)
            allowed = _values(document["properties"][field.alias or name])
            keys.append(KeyInfo(key, allowed, default, field.description or ""))
    return keys


def _values(node: Mapping[str, Any]) -> str:
    """The values that a JSON schema allows, as text: "a whole number, at least 1, or null"."""
    if "anyOf" in node:
        text = " or ".join(_values(option) for option in node["anyOf"])
        return text.replace(" or null", ", or null")
    if "enum" in node or "const" in node:
        return "one of " + ", ".join(map(str, node.get("enum", [node.get("const")])))
    text = KINDS.get(str(node.get("type", "object")), "a value")
    inner = node.get("items") or node.get("additionalProperties") or node.get("prefixItems")
    if isinstance(inner, list):  # of a fixed number
        text, inner = f"a list of {len(inner)}", inner[0]
        node = {}
    if isinstance(inner, Mapping):
        items = _values(inner)
        text += f" of ({items})" if ", " in items else f" of {items}"
    bounds = [text.format(_number(node[key])) for key, text in BOUNDS.items() if key in node]
    return ", ".join([text, *bounds])


def _number(bound: Any) -> str:
    """A bound as text: 1e6 for a million."""
    text = f"{bound:g}" if isinstance(bound, (int, float)) else str(bound)
    exact = "e" in text and float(text) == bound
    return text.replace("e+0", "e").replace("e+", "e") if exact else str(bound)


def commented_yaml(config: Section, units: WithUnit | None = None) -> str:
    """A config of any kind as YAML with the description of each key on the line above it.

    Numbers of ``units`` are written with their unit of the race, as in the files of the config.
    """
    tree, keys, units = config.model_dump(by_alias=True), describe(type(config)), units or {}
    tree = _written(tree, (), units)
    if isinstance(config, Config):
        keys += describe(type(config.learner), "learner.")
    comments = {info.key: f"{info.description} [{info.allowed}]" for info in keys}
    for location, (text, number) in units.items():
        key = ".".join(step for step in location if isinstance(step, str))
        comments[key] = f"{comments.get(key, '')} {text}: {number:g}".lstrip()
    return to_yaml(tree, comments)


def _written(node: Any, location: Location, units: WithUnit) -> Any:
    """A tree with the text of each number that has a unit of the race."""
    if isinstance(node, dict):
        return {key: _written(value, (*location, key), units) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [_written(item, (*location, index), units) for index, item in enumerate(node)]
    return units[location][0] if location in units else node
