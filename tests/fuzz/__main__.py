"""`python -m tests.fuzz`; see run.py."""

import sys

from .run import main

if __name__ == "__main__":  # a child process imports this file as well
    sys.exit(main())
