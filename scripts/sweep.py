"""Run ``quadjax sweep``."""

from quadjax.cli import main

main("sweep")
