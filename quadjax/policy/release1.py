"""Policy files of the first release: ``quadjax-policy/1``.

Their ``meta`` has an ``observation`` in place of a layout: ``wrap_next_yaw``, ``disturbance_input``
("true", "estimated" or "none") and ``disturbance``, the half-widths that the observed disturbances
are scaled by; each may be missing.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.race.layout import Field, Layout
from quadjax.race.observations import DISTURBANCES, Observation, Source, make_layout
from quadjax.vehicle.registry import MODELS

SOURCES: dict[str, Source] = {"true": "ground_truth", "estimated": "estimated", "none": "none"}


def layout_of_release_1(
    path: Path | str, meta: dict[str, Any], low: np.ndarray, high: np.ndarray
) -> Layout:
    """The layout of a file of the first release.

    Args:
        path: the file, for messages.
        meta: with ``vehicle`` and ``observation``.
        low: (4,) lowest command; the actuators are observed over the range of the commands.
        high: (4,)

    Raises:
        InputError: an unknown vehicle or an invalid observation.
    """
    if meta["vehicle"] not in MODELS:
        raise InputError(f"{path}: meta 'vehicle' is {meta['vehicle']!r}, allowed: {list(MODELS)}")
    model, seen = MODELS[meta["vehicle"]], meta.get("observation") or {}
    if not isinstance(seen, dict):
        raise InputError(f"{path}: meta 'observation' is {seen!r:.80}, expected a mapping")
    wrap, source = seen.get("wrap_next_yaw", True), seen.get("disturbance_input", "true")
    if not isinstance(wrap, bool):
        raise InputError(
            f"{path}: meta observation.wrap_next_yaw is {wrap!r:.80}, allowed: true, false"
        )
    if source not in SOURCES:
        raise InputError(
            f"{path}: meta observation.disturbance_input is {source!r:.80}, allowed: "
            f"{', '.join(SOURCES)}"
        )
    widths = _widths(path, seen.get("disturbance"))
    actuators = tuple(zip(low.tolist(), high.tolist(), strict=True))[-model.actuators.size :]

    def with_span(field: Field) -> Field:
        field = dataclasses.replace(field, value=None)
        if field.name == model.actuators.name:
            return dataclasses.replace(field, span=actuators)
        if field.name in DISTURBANCES and widths is not None:
            half = [widths.get(name, 0.0) for name in DISTURBANCES[field.name]]
            return dataclasses.replace(field, span=tuple((-width, width) for width in half))
        return field

    observed = Observation(disturbance=SOURCES[source], wrap_next_yaw=wrap)
    layout = make_layout(model, observed)
    return Layout(tuple(with_span(field) for field in layout.fields))


def _widths(path: Path | str, widths: Any) -> dict[str, float] | None:
    if widths is None:
        return None
    known = {name for names in DISTURBANCES.values() for name in names}
    fine = isinstance(widths, dict) and set(widths) <= known
    for value in widths.values() if fine else ():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        fine = fine and number and np.isfinite(value) and 0 <= value < 1e6
    if not fine:
        raise InputError(
            f"{path}: meta observation.disturbance is {widths!r:.80}, expected half-widths, not "
            f"negative, of {', '.join(sorted(known))}"
        )
    return {key: float(value) for key, value in widths.items()}
