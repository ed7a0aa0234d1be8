"""Run a subcommand in this process, as the command line does."""

from quadjax import cli


def run(*arguments: object) -> int:
    """The exit status of ``quadjax ARGUMENTS``."""
    return cli.run([str(each) for each in arguments])
