"""``python -m quadjax`` is the command ``quadjax``."""

try:
    from quadjax.cli import main
except KeyboardInterrupt:  # before the command's own handling begins
    import os

    os.write(2, b"interrupted\n")
    os._exit(130)

if __name__ == "__main__":
    main()
