"""JAX functions as CasADi expressions: a vehicle's equations are written once, in JAX."""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from quadjax.core.errors import InputError

try:
    import casadi
except ImportError:
    raise InputError("time-optimal laps need CasADi: pip install 'quadjax[limit]'") from None

Scalar = Any  # a number or a CasADi expression
Scalars = np.ndarray  # of objects, any shape

_same = lambda x: x  # noqa: E731
OPERATIONS: dict[str, Callable[..., Scalar]] = {
    "add": operator.add,
    "add_any": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "square": lambda x: x * x,
    "pow": operator.pow,
    "gt": operator.gt,
    "lt": operator.lt,
    "ge": operator.ge,
    "le": operator.le,
    "sin": casadi.sin,
    "cos": casadi.cos,
    "tanh": casadi.tanh,
    "exp": casadi.exp,
    "log": casadi.log,
    "sqrt": casadi.sqrt,
    "rsqrt": lambda x: 1.0 / casadi.sqrt(x),
    "atan2": casadi.atan2,
    "abs": casadi.fabs,
    "sign": casadi.sign,
    "max": casadi.fmax,
    "min": casadi.fmin,
    "select_n": lambda which, low, high: casadi.if_else(which, high, low),
    "copy": _same,
    "stop_gradient": _same,
    "convert_element_type": _same,
}
_MOVES = ("broadcast_in_dim", "concatenate", "expand_dims", "reshape", "slice", "squeeze", "stack")
_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat2")
_INNER = ("jaxpr", "call_jaxpr", "fun_jaxpr")


def translate(function: Callable[..., jax.Array], *examples: np.ndarray) -> Callable[..., Any]:
    """A JAX function of vectors, to a vector, as a function of CasADi columns to a column.

    It is traced in float64, with vectors of the sizes of ``examples``.

    Raises:
        InputError: on the call, an operation of ``function`` that is not supported.
    """
    with jax.enable_x64(True):
        closed = jax.make_jaxpr(function)(*(np.asarray(x, np.float64) for x in examples))

    def evaluate(*columns: Any) -> Any:
        arguments = [np.empty(column.numel(), object) for column in columns]
        for argument, column in zip(arguments, columns, strict=True):
            argument[:] = casadi.vertsplit(column)
        (result,) = _evaluate(closed.jaxpr, closed.consts, arguments)
        return casadi.vertcat(*result)

    return evaluate


def _evaluate(
    jaxpr: Jaxpr, constants: Sequence[Any], arguments: Sequence[Scalars]
) -> list[Scalars]:
    values = dict(zip(jaxpr.constvars, map(_numbers, constants), strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Any) -> Scalars:
        return _numbers(atom.val) if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        outputs = _apply(equation, [read(atom) for atom in equation.invars])
        values |= dict(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _numbers(value: Any) -> Scalars:
    """A constant of a jaxpr as an array of Python numbers."""
    return np.asarray(value).astype(object)


def _apply(equation: JaxprEqn, inputs: list[Scalars]) -> list[Scalars]:
    name, params = equation.primitive.name, equation.params
    if name in _CALLS:
        inner = next(params[key] for key in _INNER if key in params)
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return _evaluate(closed.jaxpr, closed.consts, inputs)
    if name in _MOVES:
        return [_move(equation, inputs)]
    if name == "integer_pow":
        return [_elementwise(lambda x: x ** params["y"], *inputs)]
    if name == "reduce_sum":
        total = np.add.reduce(inputs[0], axis=params["axes"], keepdims=True)
        return [total.squeeze(axis=params["axes"])]
    if name == "dot_general" and not any(params["dimension_numbers"][1]):
        left, right = inputs
        return [np.tensordot(left, right, axes=params["dimension_numbers"][0])]
    if name not in OPERATIONS:
        raise InputError(f"the vehicle model uses {name}, which time-optimal laps do not support")
    return [_elementwise(OPERATIONS[name], *inputs)]


def _move(equation: JaxprEqn, inputs: list[Scalars]) -> Scalars:
    """A primitive that only moves entries: applied to their indices, it says where they go."""
    entries = np.concatenate([array.ravel() for array in inputs])
    parts = np.split(np.arange(len(entries)), np.cumsum([array.size for array in inputs])[:-1])
    indices = [part.reshape(array.shape) for part, array in zip(parts, inputs, strict=True)]
    moved = equation.primitive.bind(*map(jax.numpy.asarray, indices), **equation.params)
    return _elementwise(lambda place: entries[place], np.asarray(moved))


def _elementwise(function: Callable[..., Scalar], *arrays: Scalars) -> Scalars:
    """A function of scalars on arrays of one shape, or of none."""
    result = np.empty(np.broadcast_shapes(*(array.shape for array in arrays)), object)
    return np.frompyfunc(function, len(arrays), 1)(*arrays, out=result)
