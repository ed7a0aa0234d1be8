"""Evaluation of JAX functions with other scalars: CasADi symbols, or intervals.

A vehicle's equations are written once, in JAX. ``translate`` traces a function to its jaxpr and
evaluates that with the operations of another kind of scalar. Arrays are NumPy arrays of objects.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from quadjax.core.errors import InputError

Scalar = Any  # whatever the operations take: a float, a CasADi expression, an interval
Operations = Mapping[str, Callable[..., Scalar]]  # by the primitive's name

ARITHMETIC: dict[str, Callable[..., Scalar]] = {
    "add": operator.add,
    "add_any": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "square": lambda x: x * x,
    "gt": operator.gt,
    "lt": operator.lt,
    "ge": operator.ge,
    "le": operator.le,
    "copy": lambda x: x,
    "copy_p": lambda x: x,
    "stop_gradient": lambda x: x,
    "convert_element_type": lambda x: x,
}
_CALLS = ("pjit", "jit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat2")
_INNER = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def translate(
    function: Callable[..., Any], operations: Operations, *examples: Any
) -> Callable[..., list[Scalar]]:
    """``function`` for other scalars than numbers.

    Args:
        function: of pytrees of scalars and arrays; traced in float64.
        operations: of the scalars, by the name of JAX's primitive; ``ARITHMETIC`` is included.
        examples: arguments of the shapes and the structure that ``function`` takes.

    Returns:
        A function of the arguments' leaves, scalars, which returns the leaves of the result.
        Only arguments and results whose leaves are scalars are supported.

    Raises:
        InputError: on the call, an operation of ``function`` that is not known.
    """
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: np.asarray(x, np.float64), examples)
        closed = jax.make_jaxpr(function)(*wide)
    table = {**ARITHMETIC, **operations}

    def evaluate(*leaves: Scalar) -> list[Scalar]:
        results = _evaluate(closed, [_box(leaf) for leaf in leaves], table)
        return [result[()] for result in results]

    return evaluate


def _box(value: Scalar) -> np.ndarray:
    boxed = np.empty((), object)
    boxed[()] = value
    return boxed


def _constant(value: Any) -> np.ndarray:
    """A constant of a jaxpr as an array of Python numbers."""
    array = np.asarray(value)
    return array.astype(object)


def _evaluate(
    closed: ClosedJaxpr, arguments: Sequence[np.ndarray], table: Operations
) -> list[np.ndarray]:
    jaxpr = closed.jaxpr
    values = dict(zip(jaxpr.constvars, map(_constant, closed.consts), strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Any) -> np.ndarray:
        return _constant(atom.val) if isinstance(atom, Literal) else values[atom]

    for equation in _needed(jaxpr):
        inputs = [read(atom) for atom in equation.invars]
        outputs = _apply(equation.primitive.name, inputs, equation.params, table)
        values |= dict(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _needed(jaxpr: Any) -> list[Any]:
    """The equations that the results depend on."""
    wanted = {atom for atom in jaxpr.outvars if not isinstance(atom, Literal)}
    found = []
    for equation in reversed(jaxpr.eqns):
        if wanted.intersection(equation.outvars):
            found.append(equation)
            wanted |= {atom for atom in equation.invars if not isinstance(atom, Literal)}
    return found[::-1]


def _apply(
    name: str, inputs: list[np.ndarray], params: dict[str, Any], table: Operations
) -> list[np.ndarray]:
    if name in _CALLS:
        inner = next(params[key] for key in _INNER if key in params)
        if not isinstance(inner, ClosedJaxpr):
            inner = ClosedJaxpr(inner, ())
        return _evaluate(inner, inputs, table)
    if name in _STRUCTURAL:
        return [_STRUCTURAL[name](table, params, *inputs)]
    if name not in table:
        raise InputError(f"the vehicle model uses {name}, which time-optimal laps do not support")
    return [elementwise(table[name], *inputs)]


def elementwise(function: Callable[..., Scalar], *arrays: np.ndarray) -> np.ndarray:
    """A function of scalars on arrays of objects of one shape, or of none."""
    shape = np.broadcast_shapes(*(array.shape for array in arrays))
    arrays = tuple(np.broadcast_to(array, shape) for array in arrays)
    result = np.empty(shape, object)
    for index in np.ndindex(shape):
        result[index] = function(*(array[index] for array in arrays))
    return result


def _power(table: Operations, params: dict[str, Any], x: np.ndarray) -> np.ndarray:
    def power(value: Scalar) -> Scalar:
        count = abs(params["y"])
        result = value
        for _ in range(count - 1):
            result = table["mul"](result, value)
        if count == 2:
            result = table["square"](value)
        return result if params["y"] > 0 else table["div"](1.0, result)

    return elementwise(power, x)


def _select(
    table: Operations, params: dict[str, Any], which: np.ndarray, *cases: np.ndarray
) -> np.ndarray:
    low, high = cases
    return elementwise(table["where"], which, high, low)


def _dot(
    table: Operations, params: dict[str, Any], left: np.ndarray, right: np.ndarray
) -> np.ndarray:
    (over_left, over_right), batched = params["dimension_numbers"]
    if any(batched):
        raise InputError("the vehicle model uses a batched matrix product: not supported")
    return _wrapped(np.tensordot(left, right, axes=(over_left, over_right)))


def _broadcast(table: Operations, params: dict[str, Any], x: np.ndarray) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(table: Operations, params: dict[str, Any], x: np.ndarray) -> np.ndarray:
    strides = params["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _sum(table: Operations, params: dict[str, Any], x: np.ndarray) -> np.ndarray:
    return _wrapped(np.add.reduce(x, axis=params["axes"]))


def _wrapped(value: Any) -> np.ndarray:
    """An array of a NumPy reduction, which returns the bare scalar for no dimensions."""
    return value if isinstance(value, np.ndarray) else _box(value)


_STRUCTURAL: dict[str, Callable[..., np.ndarray]] = {
    "integer_pow": _power,
    "select_n": _select,
    "dot_general": _dot,
    "broadcast_in_dim": _broadcast,
    "reshape": lambda table, params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda table, params, x: np.squeeze(x, axis=params["dimensions"]),
    "expand_dims": lambda table, params, x: np.expand_dims(x, params["dimensions"]),
    "transpose": lambda table, params, x: np.transpose(x, params["permutation"]),
    "concatenate": lambda table, params, *xs: np.concatenate(xs, axis=params["dimension"]),
    "stack": lambda table, params, *xs: np.stack(xs, axis=params.get("axis", params.get("dim", 0))),
    "slice": _slice,
    "reduce_sum": _sum,
}
