"""Run a subcommand in this process, as the command line does."""

import pytest

from quadjax.cli import main


def run(*words: object) -> int:
    """The exit status of ``quadjax WORDS``."""
    with pytest.raises(SystemExit) as end:
        main(None, [str(word) for word in words])
    return end.value.code
