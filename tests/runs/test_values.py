"""Files of a run whose values have another shape."""

import json
import os
from dataclasses import replace

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.training.train import create_trainer, train
from tests.fuzz.run_readers import PLAN, REGION, SUMMARY
from tests.training.toy import toy_scene

from .conftest import read_all

REGIONS = {"regions": 1, "photos": 1, "worst": [REGION]}
WRONG_SUMMARIES = [
    {"device": [1]}, {"device": 5}, {"device": None}, {"device": "x" * 5000}, {"iteration": "1"}, {"iteration": -1},
    {"iteration": 1.5}, {"train_seconds": "soon"}, {"train_seconds": -1.0}, {"gaussians": True},
    {"unexplained": 5}, {"unexplained": []}, {"unexplained": {}},
    {"unexplained": REGIONS | {"regions": "<script>"}}, {"unexplained": REGIONS | {"photos": "<b>"}},
    {"unexplained": REGIONS | {"worst": 5}}, {"unexplained": REGIONS | {"worst": [None]}},
    {"unexplained": REGIONS | {"worst": [{}]}}, {"unexplained": REGIONS | {"worst": [REGION] * 10_001}},
    *({"unexplained": REGIONS | {"worst": [REGION | each]}} for each in (
        {"photo": [1]}, {"pixels": -1}, {"stops": "x"}, {"stops": 1e300}, {"column": None}, {"box": [1, 2, 3]},
        {"box": "1234"}, {"box": [1, 2, 3, "<script>"]})),
]  # fmt: skip


def test_a_summary_of_another_shape_is_refused(run):
    loaded = load_run(run)
    for wrong in WRONG_SUMMARIES:
        (run / "summary.json").write_text(json.dumps(SUMMARY | wrong))
        with pytest.raises(InputError, match=r"summary\.json: .*; remove this file"):
            loaded.summary()


@pytest.mark.parametrize("name", ["summary.json", "plan.json", "run.json", "scene.json", "config.json"])
def test_what_is_not_an_object_is_refused(run, name):
    texts = ["", "[]", "{", '{"iteration": NaN}', '{"a": 1, "a": 2}', "[" * 100_000, "9" * 5000, "\xff\xfe\0{"]
    for text in [*texts, '{"a":' * 900 + "1" + "}" * 900]:
        (run / name).write_bytes(text.encode("latin-1"))
        with pytest.raises(InputError, match=name):
            read_all(run)


DECISION = PLAN["decisions"][0]


def test_a_plan_of_another_shape_is_refused(run):
    loaded = load_run(run)
    for wrong in (5, [5], {}, [{}], *([DECISION | each] for each in ({"name": 1}, {"fields": []}, {"reason": None}))):
        (run / "plan.json").write_text(json.dumps({"decisions": wrong}))
        with pytest.raises(InputError, match=r"plan\.json"):
            loaded.decisions()


def test_lines_of_metrics_that_do_not_fit_are_left_out(run):
    lines = ["", "[", "[]", "5", '{"iteration": 1.5}', '{"iteration": true}', '{"iteration": 1, "psnr_ldr": "x"}']
    lines += ['{"iteration": 1, "psnr_ldr": NaN}', '{"iteration": 1, "psnr_mu": 1e300}', "[" * 100_000]
    (run / "metrics.jsonl").write_text("\n".join([*lines, '{"iteration": 2, "psnr_ldr": 21.0}', '{"iter']))
    assert load_run(run).metrics() == [{"iteration": 2, "psnr_ldr": 21.0}]


def test_sparse_files_are_not_read(run):
    for name in ("summary.json", "plan.json", "metrics.jsonl"):
        os.truncate(run / name, 1 << 30)
    loaded = load_run(run)
    for read in (loaded.summary, loaded.decisions, loaded.metrics):
        with pytest.raises(InputError, match="more than the limit"):
            read()


@pytest.mark.parametrize("data", [{"max_size": 2**63}, {"exposure_index": -1}])
def test_options_that_no_reader_takes_are_refused_before_the_training(tmp_path, data):

    config = load_config("default", {"schedule.iterations": 2, "plan.enabled": False, "response.name": "srgb"})
    with pytest.raises(InputError, match=f"{next(iter(data))} = .*; use a value in its range"):
        train(toy_scene(2, 8), tmp_path / "run", config, device="cpu", data={"path": "embedded", **data})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("where", ["view", "scene", "data", "folder"])
def test_names_that_are_no_text_are_refused_before_the_training(tmp_path, where):
    """A run with such a name would be written, and then be read as damaged."""

    scene, data, out = toy_scene(2, 8), {"path": "embedded"}, tmp_path / "run"
    if where == "view":
        scene = replace(scene, views=(replace(scene.views[0], name="a\udcff"), *scene.views[1:]))
    elif where == "scene":
        scene = replace(scene, name="a\udcff")
    elif where == "data":
        data = {"path": "/photos/\udcff"}
    else:
        out = tmp_path / "a\udcff"
    config = load_config("default", {"schedule.iterations": 2, "plan.enabled": False, "response.name": "srgb"})
    with pytest.raises(InputError, match="is a name that is not UTF-8 text; rename it"):
        create_trainer(scene, out, config, device="cpu", data=data)
    assert not [path for path in tmp_path.rglob("*") if path.name != ".lock"]
