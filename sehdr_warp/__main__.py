"""`python -m sehdr_warp` is the command `sehdr-warp`."""

from .cli import main

if __name__ == "__main__":
    main()
