"""Run a subcommand in this process, as the command line does."""

import pytest

from quadjax.cli import main


def run(*arguments: object) -> int:
    """The exit status of ``quadjax ARGUMENTS``."""
    with pytest.raises(SystemExit) as end:
        main(None, [str(each) for each in arguments])
    return end.value.code
