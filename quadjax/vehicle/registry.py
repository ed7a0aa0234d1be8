"""Vehicle models by name."""

from quadjax.core.errors import InputError
from quadjax.core.imports import load_object
from quadjax.vehicle import motor, racing, rate
from quadjax.vehicle.protocol import VehicleModel

MODELS = {model.name: model for model in (motor.MODEL, rate.MODEL, racing.MODEL, racing.A2RL)}


def base_model(reference: str | VehicleModel) -> VehicleModel:
    """A vehicle model.

    Args:
        reference: a key of ``MODELS``, a ``"module:OBJECT"``, or a model.

    Raises:
        InputError: no such model.
    """
    if isinstance(reference, VehicleModel):
        return reference
    if reference in MODELS:
        return MODELS[reference]
    allowed = f"{', '.join(MODELS)} or 'module:OBJECT'"
    if ":" not in reference:
        raise InputError(f"vehicle.model is {reference!r}, allowed: {allowed}")
    loaded = load_object(reference, "vehicle.model")
    if not isinstance(loaded, VehicleModel):
        raise InputError(f"vehicle.model is {reference!r}: not a VehicleModel; allowed: {allowed}")
    return loaded
