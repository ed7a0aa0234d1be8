"""Run ``quadjax seeds``."""

from quadjax.cli import main

main("seeds")
