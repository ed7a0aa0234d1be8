"""Run ``quadjax benchmark``."""

from quadjax.cli import main

main("benchmark")
