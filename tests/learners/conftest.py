from tests.promotion import RANKS, strict

_strict = strict(RANKS)  # Optax itself mixes dtypes
