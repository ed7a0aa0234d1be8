"""Run ``quadjax fit``."""

from quadjax.cli import main

main("fit")
