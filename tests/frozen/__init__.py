"""Numbers that a change of structure must reproduce: ``python -m tests.frozen --help``."""
