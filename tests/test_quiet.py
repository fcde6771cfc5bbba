"""Silence that is over when it is over, whoever else is silent."""

import os
import threading

from sehdr_warp.quiet import silent_output, silent_stderr


def test_threads_that_are_silent_at_once_leave_what_they_found(capfd):
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
