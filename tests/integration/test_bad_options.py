"""Configs, responses and flags that cannot be used: each ends in one line that names what to change."""

import pytest

from ..refusals import train_refused

CONFIGS = {
    "not TOML": ("= 3", "not valid TOML"),
    "unknown table": ("[speed]\nfast = true", "speed"),
    "unknown field": ("[schedule]\niteration = 3", "schedule.iteration"),
    "wrong type": ('[schedule]\niterations = "many"', "schedule.iterations"),
    "a table for a number": ("[seed]\na = 1", "seed"),
    "a number for a table": ("schedule = 3", "schedule"),
    "NaN": ("[loss]\nlinear_weight = nan", "loss.linear_weight"),
    "infinite": ("[optimizer]\nmeans = inf", "optimizer.means"),
    "out of range": ("[schedule]\niterations = 0", "schedule.iterations"),
    "huge number": ("[schedule]\niterations = 99999999999999999999", "schedule.iterations"),
    "unknown base": ('base = "fastest"', "fastest"),
    "its own base": ('base = "config.toml"', "base"),
    "nested": ("a = " + "[" * 100_000, "config.toml"),
    "deep key": (".".join("a" * 5000) + " = 1", "config.toml"),
    "binary": ("\x80\x04\xff", "config.toml"),
}


@pytest.mark.parametrize("case", CONFIGS)
def test_configs(data, tmp_path, capfd, case):
    text, words = CONFIGS[case]
    (tmp_path / "config.toml").write_text(text, encoding="latin-1")
    assert words in train_refused(capfd, data, "--preset", tmp_path / "config.toml")


RESPONSES = {
    "unknown": ("kodak", None, "kodak"),
    "no number": ("gamma-x", None, "gamma-x"),
    "gamma zero": ("gamma-0", None, "gamma-0"),
    "unknown encoding": ("colour:Kodachrome", None, "Kodachrome"),
    "NaN": ("curve.csv", "0 0\n0.5 nan\n1 1\n", "curve.csv"),
    "JSON of another kind": ("curve.json", '{"kind": "spline"}', "curve.json"),
    "JSON of a wrong kind": ("curve.json", '{"kind": ["table"]}', "curve.json"),
    "pickle": ("curve.mat", "cos\nsystem\n(S'id'\ntR.", "curve.mat"),
    "pickled array": ("curve.npy", "\x93NUMPY\x01\x00", "curve.npy"),
}


@pytest.mark.parametrize("case", RESPONSES)
def test_responses(data, tmp_path, capfd, monkeypatch, case):
    name, content, words = RESPONSES[case]
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / name).write_text(content, encoding="latin-1")
    assert words in train_refused(capfd, data, "--response", name)


@pytest.mark.parametrize(
    "flags, words",
    [
        (("--max-size", "0"), "0 pixels"),
        (("--max-size", "-5"), "-5"),
        (("--iterations", "-1"), "iterations"),
        (("--seed", "-1"), "seed"),
        (("--device", "tpu"), "tpu"),
        (("--device", "meta"), "meta"),
        (("--device", "cuda:99"), "cuda:99"),
        (("--preset", "."), "."),
    ],
)
def test_flags(data, capfd, flags, words):
    assert words in train_refused(capfd, data, *flags)
