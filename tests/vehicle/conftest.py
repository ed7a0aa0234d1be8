from tests.promotion import RANKS, TYPES, strict

_strict = strict(RANKS | TYPES)
