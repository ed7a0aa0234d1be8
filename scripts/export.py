"""Run ``quadjax export``."""

from quadjax.cli import main

main("export")
