"""Limits of containers and batch jobs, from files as the kernel and Slurm write them."""

import pytest

from sehdr_warp.limits import format_bytes, memory_left, processor_limit

GB = 1 << 30


@pytest.fixture(autouse=True)
def no_job(monkeypatch):
    for name in ("SLURM_MEM_PER_NODE", "SLURM_MEM_PER_CPU", "SLURM_CPUS_ON_NODE", "SLURM_CPUS_PER_TASK"):
        monkeypatch.delenv(name, raising=False)
    processor_limit.cache_clear()


def write(root, files):
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(str(text))
    return root / "proc", root / "cgroup"


V2 = {"proc/self/cgroup": "0::/job/step\n", "cgroup/job/step/memory.max": "max\n", "cgroup/job/step/memory.current": GB,
      "cgroup/job/memory.max": 8 * GB, "cgroup/job/memory.current": 3 * GB,
      "cgroup/job/memory.stat": f"anon 5\ninactive_file {GB}\n", "cgroup/job/step/cpu.max": "150000 100000\n",
      "cgroup/job/cpu.max": "max 100000\n"}  # fmt: skip
V1 = {"proc/self/cgroup": "5:cpu,cpuacct:/box\n4:memory:/box\n1:name=systemd:/\n",
      "cgroup/memory/box/memory.limit_in_bytes": 4 * GB, "cgroup/memory/box/memory.usage_in_bytes": GB,
      "cgroup/memory/memory.limit_in_bytes": 9223372036854771712, "cgroup/memory/memory.usage_in_bytes": GB,
      "cgroup/cpu,cpuacct/box/cpu.cfs_quota_us": 400_000, "cgroup/cpu,cpuacct/box/cpu.cfs_period_us": 100_000,
      "cgroup/cpu,cpuacct/cpu.cfs_quota_us": -1, "cgroup/cpu,cpuacct/cpu.cfs_period_us": 100_000}  # fmt: skip


def test_version_2_counts_all_groups_up_to_the_root(tmp_path):
    places = write(tmp_path, V2)
    assert memory_left(*places) == 8 * GB - (3 * GB - GB)
    assert processor_limit(*places) == 2


def test_memory_from_which_the_kernel_slows_a_process_down(tmp_path):
    places = write(tmp_path, V2 | {"cgroup/job/step/memory.high": 4 * GB})
    assert memory_left(*places) == 3 * GB


@pytest.mark.parametrize("listed", ["cpu,cpuacct", "cpuacct,cpu"])
def test_version_1(tmp_path, listed):
    places = write(tmp_path, V1 | {"proc/self/cgroup": V1["proc/self/cgroup"].replace("cpu,cpuacct", listed)})
    assert memory_left(*places) == 3 * GB
    assert processor_limit(*places) == 4


def test_a_container_whose_path_is_the_hosts(tmp_path):
    places = write(tmp_path, {"proc/self/cgroup": "0::/docker/abc\n", "cgroup/memory.max": 2 * GB,
                              "cgroup/memory.current": GB, "cgroup/cpu.max": "50000 100000\n"})  # fmt: skip
    assert memory_left(*places) == GB and processor_limit(*places) == 1


def test_no_limits_and_no_cgroups(tmp_path):
    places = write(tmp_path, {"proc/self/cgroup": "0::/\n", "cgroup/memory.max": "max", "cgroup/cpu.max": "max 100000"})
    assert memory_left(*places) is None and processor_limit(*places) is None
    assert memory_left(tmp_path / "none", tmp_path / "none") is None


def test_slurm(tmp_path, monkeypatch):
    places = write(tmp_path, {"proc/self/statm": "9 1 1"})
    assert memory_left(*places, {"SLURM_MEM_PER_NODE": "4096"}) == pytest.approx(4 * GB, rel=1e-3)
    per_cpu = {"SLURM_MEM_PER_CPU": "512", "SLURM_CPUS_ON_NODE": "4"}
    assert memory_left(*places, per_cpu) == pytest.approx(2 * GB, rel=1e-3)
    per_gpu = {"SLURM_MEM_PER_GPU": "1024", "SLURM_GPUS_ON_NODE": "2"}
    assert memory_left(*places, per_gpu) == pytest.approx(2 * GB, rel=1e-3)
    assert memory_left(*places, {"SLURM_MEM_PER_NODE": "0"}) is None, "all of the machine"
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "3")
    processor_limit.cache_clear()
    assert processor_limit(*places) == 3


def test_sizes_have_the_unit_that_suits_them():
    texts = [format_bytes(count) for count in (312_000, 5.2e6, 48e6, 3.14e9, 2e13)]
    assert texts == ["312 KB", "5.2 MB", "48 MB", "3.1 GB", "20 TB"]
