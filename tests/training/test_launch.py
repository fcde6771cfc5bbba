"""Ranks as launchers number them, their devices, and the store where they meet."""

import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.training.launch import RankInfo, device_of_rank, open_store, rank_from_environment


def test_a_processor_takes_no_thousands_of_ranks():
    assert device_of_rank(1, "cpu").type == "cpu"
    with pytest.raises(SehdrError, match="100000 ranks on .* processors"):
        device_of_rank(99_999, "cpu")


def test_nodes_start_as_many_processes_each(monkeypatch):
    for name, value in {"RANK": 2, "WORLD_SIZE": 3, "LOCAL_WORLD_SIZE": 1, "GROUP_WORLD_SIZE": 2}.items():
        monkeypatch.setenv(name, str(value))
    with pytest.raises(SehdrError, match="3 ranks on 2 nodes, and 1 on this one"):
        rank_from_environment()
    monkeypatch.setenv("GROUP_WORLD_SIZE", "3")
    assert rank_from_environment() == RankInfo(2, 3, 0, 1, 2, 3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("RANK", value) for value in ("x", "3", "-1")),
        *(("WORLD_SIZE", value) for value in ("0", "1000000000")),
        *(("LOCAL_WORLD_SIZE", "0"), ("LOCAL_RANK", "7"), ("GROUP_RANK", "-1")),
    ],
)
def test_numbers_that_no_launcher_sets_are_refused(monkeypatch, name, value):
    for each, number in {"RANK": "1", "WORLD_SIZE": "3", name: value}.items():
        monkeypatch.setenv(each, number)
    with pytest.raises(SehdrError, match=f"{name} = {value} is not a number from"):
        rank_from_environment()


@pytest.mark.parametrize("port", ["x", "0", "99999", "9" * 5000])
def test_ports_that_cannot_be_are_refused(monkeypatch, port):
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    monkeypatch.setenv("MASTER_PORT", port)
    with pytest.raises(SehdrError, match="is not a port from 1 to 65535"):
        open_store(RankInfo(0, 2, 0, 2), 1.0)
