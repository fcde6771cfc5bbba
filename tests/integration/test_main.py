import subprocess
import sys

import pytest

LIMIT = """
import resource
pages = int(open('/proc/self/statm').read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (1 << 20),) * 2)
raise SystemError('returned NULL without setting an exception')
"""
CAUSES = {"no memory": "raise MemoryError", "anything without address space": LIMIT}


def ended(code: str) -> subprocess.CompletedProcess:
    """Run the program with a command line that runs `code`."""
    body = f"import sehdr_warp.cli as cli\ndef main():\n exec({code!r})\ncli.main = main\n"
    program = body + "from sehdr_warp.__main__ import run\nrun()"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.skipif(sys.platform != "linux", reason="address space is limited on Linux alone")
@pytest.mark.parametrize("name", CAUSES)
def test_exhausted_memory_ends_in_one_line(name):
    result = ended(CAUSES[name])
    assert result.returncode == 1 and result.stderr.startswith("sehdr-warp: out of memory; "), result.stderr
    assert result.stderr.count("\n") == 1


def test_a_defect_of_the_program_is_not_hidden():
    result = ended("raise SystemError('NULL')")
    assert result.returncode == 1 and "Traceback" in result.stderr and "out of memory" not in result.stderr
