"""Silence that is over when it is over, whoever else is silent."""

import os
import subprocess
import sys
import threading

import pytest

from sehdr_warp import __version__
from sehdr_warp.quiet import silent_output, silent_stderr


def test_threads_that_silence_at_once_restore_the_streams(capfd):
    both, done = threading.Barrier(2), threading.Event()

    def silent():
        with silent_output():
            both.wait(10)
            assert done.wait(10)

    thread = threading.Thread(target=silent)
    thread.start()
    with silent_output(), silent_stderr():
        both.wait(10)
        os.write(1, b"lost")
        os.write(2, b"lost")
    os.write(1, b"lost too")
    done.set()
    thread.join()
    os.write(1, b"told")
    os.write(2, b"told as well")
    assert capfd.readouterr() == ("told", "told as well")


def test_libraries_are_silent_when_python_ends():
    """OpenImageIO lists what Python still held of it, tens of lines."""
    pytest.importorskip("OpenImageIO")
    hold = "import ctypes, sys, OpenImageIO; "
    hold += "ctypes.pythonapi.Py_IncRef(ctypes.py_object(OpenImageIO.TypeDesc('float'))); "
    code = hold + "from sehdr_warp.cli import main; main(['--version'])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == f"sehdr-warp {__version__}\n" and ended.stderr == ""
    code = hold + "from sehdr_warp.quiet import silence_exit; silence_exit(); sys.exit('what the program says last')"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.stderr == "what the program says last\n"
