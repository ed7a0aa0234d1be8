"""Run ``quadjax evaluate``."""

from quadjax.cli import main

main("evaluate")
