"""Run ``quadjax compare``."""

from quadjax.cli import main

main("compare")
