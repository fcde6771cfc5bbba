"""Errors of the system in one line, and arguments by their names in Python."""

import pytest

from sehdr_warp.errors import InputError, SehdrError, UsageError, as_user_error, flags_in_messages


def caused(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    "error, message",
    [
        (OSError(36, "File name too long", "nnn"), "nnn: cannot be used (File name too long); check"),
        (OSError(5, "Input/output error"), "a file: cannot be used (Input/output error)"),
        (MemoryError(), "out of memory (no more)"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 8 bytes"), "out of memory (Default"),
        (SystemError("error return without exception set"), "out of memory (error return"),
        (caused(SystemError("NULL"), MemoryError()), "out of memory (NULL"),
        (caused(RuntimeError("x"), OSError(12, "Cannot allocate memory")), "out of memory (x"),
        (ImportError("libx.so: failed to map segment from shared object"), "out of memory (libx.so"),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates"), r"'\udcff': is a name that is not UTF-8"),
        (UsageError("train needs --out"), "train needs --out"),
        (ZeroDivisionError(), None),
        (RuntimeError("shapes differ"), None),
    ],
)
def test_errors_of_the_system_are_one_line(error, message):
    user_error = as_user_error(error)
    assert user_error is None if message is None else str(user_error).startswith(message)


def test_errors_name_arguments_in_python_and_flags_on_the_command_line():
    error = InputError("runs/a", "exists", "use --resume, or type `sehdr-warp train --overwrite`")
    python = "runs/a: exists; use resume=True, or type `sehdr-warp train --overwrite`"
    with flags_in_messages():
        assert str(error) == "runs/a: exists; use --resume, or type `sehdr-warp train --overwrite`"
    assert str(error) == python
    no_surface = SehdrError("there is no surface to mesh; take another --crop, up and --up=0,1,0 or --device cpu")
    assert str(no_surface).endswith('take another crop, up and up=0,1,0 or device="cpu"')
    assert str(SehdrError("--camera a: is not in --cameras b")) == "camera a: is not in cameras b"
    assert str(UsageError("no flag --resume")) == "no flag --resume"
