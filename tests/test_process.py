"""Standard streams that fail, signals that end, and what the system refuses: one line, and the work is not lost."""

import os
import platform
import signal
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "line, code, message",
    [
        ("presets --json > /dev/full", 1, "sehdr-warp: standard output cannot be written (No space left on device)"),
        ("presets --json >&-", 1, "sehdr-warp: standard output cannot be written (Bad file descriptor)"),
        ("presets --json 2>&- | grep -q purpose", 0, ""),
        ("presets 2> /dev/full <&-", 0, ""),
        ("frobnicate 2> /dev/full", 2, ""),
    ],
)
def test_closed_and_full_streams(line, code, message):
    call = f"{sys.executable} -m sehdr_warp {line}"
    ended = subprocess.run(["bash", "-c", call], capture_output=True, text=True, check=False)
    assert ended.returncode == code and ended.stderr.startswith(message) and ended.stderr.count("\n") == bool(message)


def test_a_failed_write_to_stderr_does_not_end_the_work():
    program = "import os, sys; from sehdr_warp.process import prepare; prepare(); print('loss', file=sys.stderr)\n"
    program += "sys.stderr.flush(); os.write(2, b'to nowhere'); print('done')"
    call = ["bash", "-c", '"$0" -c "$1" 2> /dev/full', sys.executable, program]
    assert subprocess.run(call, stdout=subprocess.PIPE, check=True).stdout == b"done\n"


def test_only_the_first_garbage_collection_is_late():
    program = """
import gc
from sehdr_warp.process import collect_late
usual, frozen, begun = gc.get_threshold(), gc.get_freeze_count(), len(gc.callbacks)
collect_late()
late = gc.get_threshold()
collect_late()  # Once is enough: the second would take the first's threshold for the usual one.
assert gc.isenabled() and late == gc.get_threshold() and late[0] > 100 * usual[0]
gc.collect()
collect_late()
assert gc.get_threshold() == usual and len(gc.callbacks) == begun
assert gc.get_freeze_count() > frozen  # What was there is never looked through again ...
circle = []
circle.append(circle)
del circle
assert gc.collect() > 0  # ... and what comes is.
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_importing_the_package_leaves_garbage_collection_alone():
    program = """
import gc
before = gc.get_threshold(), len(gc.callbacks), gc.get_freeze_count()
import sehdr_warp, sehdr_warp.cli
sehdr_warp.load_scene, sehdr_warp.train
assert before == (gc.get_threshold(), len(gc.callbacks), gc.get_freeze_count())
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_a_pool_starts_a_thread_ends_the_process(number):
    """The pool would otherwise forget the thread, and the end of the process would wait for it."""
    program = f"""
import os, signal, sys, threading, time
from concurrent.futures import ThreadPoolExecutor
signal.signal(signal.SIGINT, signal.default_int_handler)
from sehdr_warp import process
process.prepare()
start = threading.Thread.start
def start_late(thread):
    start(thread)
    if thread.name.startswith("pool"):
        os.kill(os.getpid(), {int(number)})
        time.sleep(0.01)
threading.Thread.start = start_late
pool = ThreadPoolExecutor(1, thread_name_prefix="pool")
try:
    pool.submit(time.sleep, 0)
    time.sleep(60)
except KeyboardInterrupt:
    sys.exit(130)
"""
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=30)
    assert child.returncode == 128 + number and not child.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("kind", ["complete", "that clears errors", "without an end"])
def test_a_signal_waits_for_the_end_of_an_import(tmp_path, kind, number):
    """Nothing is raised into a module, which would be half made afterwards, or lose the signal."""
    waits = 60 if kind == "without an end" else 1
    body = f"import os, time\nos.write(1, b'begun')\ntime.sleep({waits})"
    if kind == "that clears errors":
        body = "\n".join(["try:", *[f"    {line}" for line in body.splitlines()], "except BaseException: pass"])
    (tmp_path / "slow.py").write_text(f"{body}\nos.write(1, b' complete')\n")
    program = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # A job in the background ignores it.
from sehdr_warp import process
process.prepare()
process.LONGEST_IMPORT = 3.0
try:
    import slow
    time.sleep(60)
except KeyboardInterrupt:
    sys.exit(130)
"""
    child = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(["", *filter(None, sys.path)])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert child.stdout is not None and os.read(child.stdout.fileno(), 5) == b"begun"
    child.send_signal(number)
    output, errors = child.communicate(timeout=50)
    assert child.returncode == 128 + number and b"Traceback" not in errors
    assert output == (b"" if kind == "without an end" else b" complete")


@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space as Linux has them")
@pytest.mark.parametrize("mebibytes", [18, 24, 40, 200])
def test_little_address_space_is_one_line_whatever_finds_none(tmp_path, mebibytes):
    """Also while modules load, and if not even the line of the error finds memory."""
    call = f"ulimit -v {mebibytes << 10}; {sys.executable} -m sehdr_warp train embedded --out run"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    ended = subprocess.run(
        ["bash", "-c", call], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1 and ended.stderr.startswith("sehdr-warp: out of memory"), ended.stderr
    assert "ulimit -v" in ended.stderr and ended.stderr.count("\n") == 1 and list(tmp_path.iterdir()) == []


def test_names_are_utf8_in_any_locale(tmp_path):
    """Names are UTF-8 even in the locale C, where Python may be set to expect ASCII."""
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    (tmp_path / "für.toml").write_text('base = "demo"\nseed = 7\n')
    done = subprocess.run(
        [sys.executable, "-m", "sehdr_warp", "config", "für.toml", "--diff"],
        cwd=tmp_path,
        env={**environment, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        timeout=60,
    )
    assert done.returncode == 0 and b"seed = 7" in done.stdout, done.stderr


def test_a_deleted_working_directory_is_an_error(tmp_path):
    code = "import os, sys; os.rmdir(os.getcwd()); sys.argv = ['sehdr-warp', 'presets']; "
    code += "from sehdr_warp.__main__ import run; run()"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1 and done.stderr.startswith("sehdr-warp: the working directory cannot be used"), done
    assert len(done.stderr.splitlines()) == 1


RETURNS = """
import ctypes, os, sys
from sehdr_warp.process import return_memory
if sys.argv[1] == "yes":
    return_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
class Statistics(ctypes.Structure):
    names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    _fields_ = [(name, ctypes.c_size_t) for name in names.split()]
libc.mallinfo2.restype = Statistics
others = libc.mallinfo2().hblks
for _ in range(3):  # The first blocks raise the size from which glibc maps others, unless it is fixed.
    blocks = [libc.malloc(20 << 20) for _ in range(8)]
    mapped = libc.mallinfo2().hblks - others
    for block in blocks:
        libc.free(block)
print(mapped)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="reads glibc's statistics")
def test_large_blocks_go_back_to_the_system():
    mapped = {
        word: int(subprocess.run([sys.executable, "-c", RETURNS, word], capture_output=True, check=True).stdout)
        for word in ("yes", "no")
    }
    assert mapped == {"yes": 8, "no": 0}, "large blocks are mapped, so that they go back when they are freed"
