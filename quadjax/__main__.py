"""``python -m quadjax`` is the command ``quadjax``."""

from quadjax.cli import main

if __name__ == "__main__":
    main()
