"""Run ``quadjax sweep``."""

from quadjax.cli import main

if __name__ == "__main__":  # worker processes import this file
    main("sweep")
