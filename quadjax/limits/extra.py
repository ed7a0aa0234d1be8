"""CasADi, or one line that says how to install it."""

from quadjax.core.errors import InputError

try:
    import casadi
except ImportError:
    raise InputError("time-optimal laps need CasADi: pip install 'quadjax[limit]'") from None

# The operations of ``quadjax.limits.jaxpr`` for CasADi's symbols.
OPERATIONS = {
    "sin": casadi.sin,
    "cos": casadi.cos,
    "tan": casadi.tan,
    "tanh": casadi.tanh,
    "atan2": casadi.atan2,
    "sqrt": casadi.sqrt,
    "rsqrt": lambda x: 1.0 / casadi.sqrt(x),
    "exp": casadi.exp,
    "log": casadi.log,
    "abs": casadi.fabs,
    "max": casadi.fmax,
    "min": casadi.fmin,
    "sign": casadi.sign,
    "floor": casadi.floor,
    "pow": lambda x, y: x**y,
    "logistic": lambda x: 1.0 / (1.0 + casadi.exp(-x)),
    "and": casadi.logic_and,
    "or": casadi.logic_or,
    "not": casadi.logic_not,
    "eq": lambda x, y: x == y,
    "ne": lambda x, y: x != y,
    "where": casadi.if_else,
}
