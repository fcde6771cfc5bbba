"""A disk that takes no more, for tests."""

import resource
from contextlib import contextmanager


@contextmanager
def full_disk():
    """A limit on the size of files stands in for a full disk: writes past it fail with EFBIG, whoever makes them.

    Not a fixture: pytest reports before fixtures end, and its own output may go to a file that is larger.
    """
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
