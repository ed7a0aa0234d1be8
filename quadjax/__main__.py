"""``python -m quadjax`` is the command ``quadjax``."""

from quadjax.cli import main

main()
