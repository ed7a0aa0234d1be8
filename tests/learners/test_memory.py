"""The memory of programs and of the machine."""

import jax
import jax.numpy as jnp
import pytest

from quadjax.core.errors import InputError
from quadjax.learners.parallel import check_memory, make_mesh, program_bytes


def test_a_program_counts_its_arguments_its_result_and_what_is_between():
    x = jax.ShapeDtypeStruct((128, 128), jnp.float32)
    program = jax.jit(lambda a, b: jnp.sin(a @ b) @ a).lower(x, x).compile()
    size = x.size * x.dtype.itemsize
    assert 4 * size <= program_bytes(program) <= 6 * size


def test_more_than_there_is_is_refused():
    check_memory(1e6, make_mesh(1))
    with pytest.raises(InputError, match="training needs about .* GiB of memory on each device"):
        check_memory(1e18, make_mesh(1))
