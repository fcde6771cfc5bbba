"""A run that somebody sent: reading it changes nothing, follows no link, and refuses in one line what does not fit."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.model.confidence import Evidence
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.run_writer import RunWriter, write_confidence
from sehdr_warp.runs.scene_description import changed_photos, photo_signature
from sehdr_warp.training.train import create_trainer, train
from tests.fuzz.run_readers import PLAN, REGION, SUMMARY, make_confidence, make_run
from tests.training.toy import toy_scene
from tests.trial.harness import files_in


@pytest.fixture
def run(tmp_path):
    """A run with every file that a run may have."""
    make_confidence(tmp_path / "run")
    return tmp_path / "run"


def read_all(path):
    run = load_run(path)
    return run.metrics(), run.summary(), run.decisions(), run.clipped_share()


def test_reading_changes_nothing(run):
    before = files_in(run)
    metrics, summary, decisions, clipped = read_all(run)
    assert summary == SUMMARY and decisions == PLAN["decisions"] and len(metrics) == 1 and len(clipped) == 4
    assert files_in(run) == before


FILES = ["config.json", "scene.json", "run.json", "plan.json", "summary.json", "metrics.jsonl"]
FILES += ["confidence.safetensors", "checkpoints", "checkpoints/iteration_00000000", ".lock", "tensorboard"]
FILES += ["checkpoints/iteration_00000000/state.safetensors", "checkpoints/iteration_00000000/checkpoint.json"]


@pytest.mark.parametrize("name", FILES)
def test_a_link_is_refused_even_to_a_sound_file(run, name):
    moved = run.parent / "elsewhere"
    if (run / name).exists():
        (run / name).rename(moved)
    else:
        moved.mkdir()
    (run / name).symlink_to(moved)
    before = files_in(run.parent)
    with pytest.raises(InputError, match="is a link"):
        read_all(run)
    for how in ({"resume": True, "overwrite": False}, {"resume": False, "overwrite": True}):
        with pytest.raises(InputError, match="is a link"):
            RunWriter(run).check_start(**how)
    assert files_in(run.parent) == before


@pytest.mark.parametrize("name", [".new", ".ready"])
@pytest.mark.parametrize("place", ["itself", "inside"])
def test_links_in_place_of_an_interrupted_write_move_nothing(run, name, place):
    precious = run.parent / "precious"
    (precious / "checkpoints").mkdir(parents=True)
    (precious / "thesis.txt").write_text("mine")
    link = run / name if place == "itself" else run / name / "checkpoints"
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(precious if place == "itself" else precious / "checkpoints")
    before = files_in(run.parent)
    for act in (
        lambda: read_all(run),
        lambda: RunWriter(run).check_start(resume=True, overwrite=False),
        lambda: RunWriter(run).lock(),
    ):
        with pytest.raises(InputError, match="is a link"):
            act()
    assert files_in(run.parent) == before


def test_only_a_training_finishes_an_interrupted_write(run):
    """A new run, complete beside the one that it replaces: reading leaves both alone, a training takes the new one."""
    other = run.parent / "other"
    make_run(other)
    (other / ".lock").unlink()
    for name in ("summary.json", "metrics.jsonl"):
        (other / name).unlink()
    shutil.move(other, run / ".new")
    before = files_in(run)
    assert read_all(run)[1] == SUMMARY and files_in(run) == before
    assert RunWriter(run).check_start(resume=True, overwrite=False)
    assert not (run / ".new").exists() and RunFolder(run).read_summary() == {}
    load_run(run)


def test_a_run_whose_replacement_was_interrupted_says_so(run):
    (run / ".new").mkdir()
    (run / "run.json").unlink()
    with pytest.raises(InputError, match="being replaced.*--resume"):
        load_run(run)


def test_another_programs_folder_of_that_name_is_left_alone(tmp_path):
    (tmp_path / ".new").mkdir()
    (tmp_path / ".new" / "thesis.txt").write_text("mine")
    before = files_in(tmp_path)
    for how in ({"resume": True, "overwrite": False}, {"resume": False, "overwrite": True}):
        with pytest.raises(InputError, match=r"thesis\.txt: lies in the folder of a new run"):
            RunWriter(tmp_path).check_start(**how)
    assert {name: text for name, text in files_in(tmp_path).items() if name != ".lock"} == before


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


def test_a_sparse_checkpoint_is_refused_by_its_length(run):
    """Reading 40 GiB for its hash would take a minute."""
    os.truncate(next(run.glob("checkpoints/*/state.safetensors")), 40 << 30)
    with pytest.raises(InputError, match="is not safetensors"):
        load_run(run)


def test_files_that_may_not_be_read_say_so(run, monkeypatch):
    """As root reads everything, the system's answer is made up."""
    folder = RunFolder(run)
    listdir = os.listdir

    def refuse(path):
        if str(path).endswith("checkpoints"):
            raise PermissionError(13, "Permission denied", str(path))
        return listdir(path)

    monkeypatch.setattr(os, "listdir", refuse)
    with pytest.raises(InputError, match=r"checkpoints: cannot be read \(Permission denied\); check its rights"):
        folder.newest_checkpoint()


def test_a_lock_that_was_removed_stops_the_writer(run):
    writer = RunWriter(run)
    writer.lock()
    writer.append_metrics({"iteration": 3})
    (run / ".lock").unlink()
    other = RunWriter(run)
    other.lock()
    for write in (
        lambda: writer.append_metrics({"iteration": 4}),
        lambda: writer.write_summary({}),
        lambda: writer.write_checkpoint({"a": torch.zeros(1)}, {"iteration": 1}, keep=1),
        lambda: writer.rewind_metrics(0),
    ):
        with pytest.raises(SehdrError, match=r"\.lock: was removed"):
            write()
    other.unlock()
    writer.unlock()


def test_resume_begins_where_nothing_was_begun(tmp_path):
    for folder in (tmp_path, tmp_path / "missing"):
        assert not RunWriter(folder).check_start(resume=True, overwrite=False)


def test_confidence_is_the_same_file_each_time(run):

    evidence, folder = Evidence(*torch.rand(5, 4)), RunFolder(run)
    contents = set()
    for _ in range(8):
        write_confidence(folder, evidence, "a" * 64)
        contents.add(folder.confidence.read_bytes())
    assert len(contents) == 1


def test_photos_that_were_changed_are_noticed(run):
    scene = toy_scene(2, 8)
    folder = RunFolder(run)
    folder.check_same_scene(scene)
    changed = [view.codes.copy() for view in scene.views]
    changed[0][:3, :3] = 255 - changed[0][:3, :3]
    views = tuple(replace(view, codes=codes) for view, codes in zip(scene.views, changed, strict=True))
    with pytest.raises(
        InputError, match=f"photos or masks were changed since the training began: {scene.views[0].name};"
    ):
        folder.check_same_scene(replace(scene, views=views))


@pytest.mark.parametrize("part, change", [("splits", {"split": "test"}), ("exposure times", {"exposure_time": 9.0})])
def test_what_differs_from_the_scene_of_a_run_is_named(run, part, change):
    scene = toy_scene(2, 8)
    changed = replace(scene, views=(replace(scene.views[0], **change), *scene.views[1:]))
    with pytest.raises(InputError, match=f"its {part} differ.* if another version decided"):
        RunFolder(run).check_same_scene(changed)


def test_masks_that_were_changed_are_noticed(run):
    scene = toy_scene(2, 8)
    mask = np.ones(scene.views[0].codes.shape[:2], np.float32)
    masked = replace(scene, views=tuple(replace(view, mask=mask) for view in scene.views))
    with pytest.raises(InputError, match="photos or masks were changed"):
        RunFolder(run).check_same_scene(masked)
    ones, half = (photo_signature(scene.views[0].codes, mask * part) for part in (1, 0.5))
    assert changed_photos({"a": ones}, {"a": half}) == ["a"] and not changed_photos({"a": ones}, {"a": ones})


def test_a_signature_forgives_rounding_alone():
    rng = np.random.default_rng(3)
    for shape, kind in (((31, 45, 3), np.uint8), ((3, 2, 3), np.uint8), ((300, 20, 3), np.uint16)):
        codes = rng.integers(0, np.iinfo(kind).max, shape).astype(kind)
        other = np.clip(codes.astype(int) + rng.integers(-1, 2, shape), 0, np.iinfo(kind).max).astype(kind)
        assert not changed_photos({"a": photo_signature(codes)}, {"a": photo_signature(other)})
        assert changed_photos({"a": photo_signature(codes)}, {"a": photo_signature(codes[::-1])}) == ["a"]
    assert changed_photos({"a": "no digits", "b": "00"}, {"a": "00", "c": "00"}) == ["a"]


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


def test_a_place_that_cannot_be_written_is_refused_before_the_photos_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(InputError, match=f"cannot be written, because {tmp_path} is read-only"):
        RunWriter(tmp_path / "runs" / "first").check_start(resume=False, overwrite=False)
    assert not list(tmp_path.iterdir())
