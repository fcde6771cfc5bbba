"""Every reader of files, with small real files to start from."""

from . import output_readers, photo_readers, run_readers, scene_readers

READERS = scene_readers.READERS | photo_readers.READERS | run_readers.READERS | output_readers.READERS
