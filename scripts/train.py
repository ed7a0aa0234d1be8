"""Run ``quadjax train``."""

from quadjax.cli import main

main("train")
