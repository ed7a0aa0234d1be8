"""The memory of programs and of the machine."""

import jax
import jax.numpy as jnp
import pytest

from quadjax.core.errors import InputError
from quadjax.learners.memory import check_memory, memory_bytes, program_bytes, tree_bytes
from quadjax.learners.sharding import make_mesh


def test_a_program_counts_its_arguments_its_result_and_what_is_between():
    x = jax.ShapeDtypeStruct((128, 128), jnp.float32)
    program = jax.jit(lambda a, b: jnp.sin(a @ b) @ a).lower(x, x).compile()
    assert 4 * tree_bytes(x) <= program_bytes(program) <= 6 * tree_bytes(x)


def test_more_than_there_is_is_refused():
    mesh = make_mesh(1)
    check_memory(0.9 * memory_bytes(), mesh)
    with pytest.raises(InputError, match="training needs about"):
        check_memory(1.1 * memory_bytes(), mesh)
    assert memory_bytes(2) <= memory_bytes()
