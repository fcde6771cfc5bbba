"""Fuzzing of every file reader: real small files, mutated; `python -m tests.fuzz --help`."""
