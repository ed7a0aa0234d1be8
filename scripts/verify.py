"""Run ``quadjax verify``."""

from quadjax.cli import main

main("verify")
