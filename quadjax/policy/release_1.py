"""The observation of policy files of the first release, ``quadjax-policy/1``."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.sections import Field, Section, validate
from quadjax.race.layout import Layout, ObservedField
from quadjax.race.observation_config import Observation, Source
from quadjax.race.observations import DISTURBANCES, make_layout
from quadjax.vehicle.registry import MODELS

SOURCES: dict[str, Source] = {"true": "ground_truth", "estimated": "estimated", "none": "none"}
WidthName = Annotated[str, Field(pattern=r"^(moment_[xyz]|force_z)$")]
HalfWidth = Annotated[float, Field(ge=0, lt=1e6)]


class Release1(Section):
    """The metadata ``observation`` of the first release, in place of a layout.

    ``disturbance`` has the half-widths that the observed disturbances are scaled by.
    """

    wrap_next_yaw: bool = True
    disturbance_input: Literal["true", "estimated", "none"] = "true"
    disturbance: dict[WidthName, HalfWidth] | None = Field(None, max_length=4)


def layout_of_release_1(
    path: Path | str, meta: dict[str, Any], low: np.ndarray, high: np.ndarray
) -> Layout:
    """The layout of a file of the first release.

    Args:
        path: the file, for messages.
        meta: with ``vehicle`` and ``observation``.
        low: (4,) lowest command; the actuators are observed over the range of the commands.
        high: (4,) highest command.

    Raises:
        InputError: an unknown vehicle or an invalid observation.
    """
    if meta["vehicle"] not in MODELS:
        raise InputError(f"{path}: meta: vehicle is {meta['vehicle']!r}, allowed: {list(MODELS)}")
    model = MODELS[meta["vehicle"]]
    release1 = validate(Release1, meta.get("observation") or {}, f"{path}: meta", "observation.")
    actuators = tuple(zip(low.tolist(), high.tolist(), strict=True))[-model.actuators.size :]

    def with_span(field: ObservedField) -> ObservedField:
        span = actuators if field.name == model.actuators.name else field.span
        if field.name in DISTURBANCES and release1.disturbance is not None:
            half = [release1.disturbance.get(name, 0.0) for name in DISTURBANCES[field.name]]
            span = tuple((-width, width) for width in half)
        return dataclasses.replace(field, value=None, span=span)

    source = SOURCES[release1.disturbance_input]
    observed = Observation(disturbance=source, wrap_next_yaw=release1.wrap_next_yaw)
    return Layout(tuple(with_span(field) for field in make_layout(model, observed).fields))
