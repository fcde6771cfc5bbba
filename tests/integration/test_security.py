"""SECURITY.md, held: every sentence names the tests that would notice if it were not so."""

import ast
import pickle
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.evaluation.perceptual import load_lpips
from sehdr_warp.files import resolve_inside
from sehdr_warp.runs.run import load_run
from sehdr_warp.scene import load_scene
from sehdr_warp.viewer.commands import View
from sehdr_warp.viewer.server import Server, Viewer
from tests.make_scenes import write_llff
from tests.trial import harness

ROOT = Path(__file__).resolve().parents[2]
CASES, COMMAND_LINES, LOOKS, PHOTOS, PLACES, REQUESTS, SENT_RUNS, SETS = (
    f"trial/test_{n}.py::test"
    for n in ("cases", "command_lines", "looks", "photos", "places", "requests", "runs", "sets")
)
RUNS, HERE = "runs/test_run_folder.py::test", "integration/test_security.py::test"
HELD_BY = {
    "Looking at a run changes nothing": [f"{RUNS}_reading_changes_nothing", f"{SENT_RUNS}_links_in_a_sent_run"],
    "Only a training that holds": [
        f"{RUNS}_only_a_training_finishes_an_interrupted_write",
        f"{CASES}_two_trainings_do_not_mix",
        f"{SENT_RUNS}_locks_that_are_no_locks",
    ],
    "Links inside a run are refused": [
        f"{RUNS}_a_link_is_refused_even_to_a_sound_file",
        f"{SENT_RUNS}_links_in_a_sent_run",
        f"{PLACES}_links_that_a_user_made",
        "blocks/test_block_plan.py::test_links_in_the_run_are_not_followed",
    ],
    "All JSON of a run is checked": [
        f"{RUNS}_a_summary_of_another_shape_is_refused",
        f"{CASES}_tampered_runs",
        f"{SENT_RUNS}_texts_of_a_run",
    ],
    "What decides the picture": [
        "runs/test_checkpoint.py::test_what_decides_the_picture_is_hashed_with_the_checkpoint"
    ],
    "The hash finds damage": ["runs/test_checkpoint.py::test_a_damaged_newest_falls_back", f"{CASES}_tampered_runs"],
    "It is no signature": [f"{CASES}_tampered_runs"],
    "Nothing that is read is run or unpickled": [
        f"{HERE}_no_code_unpickles_or_evaluates",
        f"{HERE}_pickles_are_refused",
        "scene/images/test_ldr_files.py::test_other_formats_and_colors_are_refused_and_no_program_is_started",
    ],
    "Text from outside enters HTML escaped": [
        "output/report/test_page.py::test_browsers_run_our_script_and_no_other",
        "output/report/test_page.py::test_no_markup_is_made_but_by_the_one_function",
        f"{PLACES}_names_of_photos_on_pages_and_terminals",
    ],
    "Control characters from outside": [
        "test_console.py::test_a_terminal_obeys_nothing_of_what_files_say",
        f"{PLACES}_names_in_lists_on_terminals",
    ],
    "Pictures are decoded by content": [
        "scene/images/test_ldr_files.py::test_other_formats_and_colors_are_refused_and_no_program_is_started",
        f"{PHOTOS}_photos_that_were_made",
    ],
    "Sizes and counts are bounded": [
        f"{CASES}_sparse_files_of_4_gib_are_not_read_whole",
        "trial/test_splats.py::test_splats",
        f"{PHOTOS}_opcodes_of_dng",
        f"{RUNS}_sparse_files_are_not_read",
        f"{RUNS}_a_sparse_checkpoint_is_refused_by_its_length",
        f"{SENT_RUNS}_tensors_of_a_run",
        "splats/test_streamed_sog.py::test_a_small_index_takes_no_memory_that_its_chunks_do_not_state",
        "scene/images/test_heif.py::test_parts_of_an_item_that_overlap_take_no_memory",
    ],
    "Pipes and devices are not read": [
        f"{CASES}_inputs_that_are_pipes_are_not_waited_for",
        "test_files.py::test_devices_and_pipes_are_not_read",
    ],
    "What has the name of a run's or a set's file": [
        "test_files.py::test_what_has_the_name_of_a_file_is_not_taken_for_a_missing_one",
        "trial/test_runs.py::test_kinds_of_files_of_a_run",
        "trial/test_sets.py::test_kinds_of_files_of_a_set",
    ],
    "Environment variables of a launcher": [
        "training/test_nodes.py::test_numbers_that_no_launcher_sets_are_refused",
        "training/test_nodes.py::test_ports_that_cannot_be_are_refused",
        "trial/test_command_lines.py::test_ranks",
    ],
    "Names in a data set stay inside": [
        f"{HERE}_names_of_a_set_stay_inside",
        f"{SETS}_links_that_lead_out_of_a_set",
        "scene/test_masks.py::test_folders_that_lead_out_of_the_set_are_not_searched",
        "scene/readers/test_colmap.py::test_the_folder_of_photos_may_be_a_link",
    ],
    "OpenUSD and MATLAB files, and videos": [
        "test_sandbox.py::test_bounds",
        "scene/video/test_decode.py::test_counts_beyond_the_file_take_no_memory",
    ],
    "A stage that refers to files": [
        "test_sandbox.py::test_a_stage_leads_to_no_other_folder",
        "scene/video/test_decode.py::test_a_clip_that_names_other_files_is_refused",
        "trial/test_clips.py::test_clips_that_were_made",
    ],
    "LUTs of a config must be files": [
        "output/images/test_ocio.py::test_luts_that_cannot_be_read_are_told_in_a_line",
        f"{LOOKS}_luts_that_were_made",
        f"{LOOKS}_archives_of_configs",
    ],
    "The caches": [
        "rasterizer/warp_launch/test_kernel_cache.py::test_damaged_modules_go_and_are_told_once",
        "scene/video/test_frames.py::test_frames_are_kept_in_the_cache",
    ],
    "The processes of one training": ["training/test_ranks.py::test_ranks_stay_alike_and_one_can_go_on"],
    "It reads the paths": [f"{PLACES}_what_commands_open"],
    "It writes only to the paths": [f"{COMMAND_LINES}_names_of_output", f"{PLACES}_what_commands_open"],
    "A file is replaced only": [
        f"{CASES}_obstacles_are_kept",
        "test_files.py::test_existing_file_is_kept_unless_asked",
    ],
    "Links, devices and pipes are never": ["test_files.py::test_links_devices_and_pipes_are_never_replaced"],
    "A run is replaced only": ["trial/test_kills.py::test_training_killed_at_a_change_of_the_disk"],
    "A film is one file": [
        "output/test_film.py::test_urls_are_refused",
        "output/test_film.py::test_formats_of_several_files_and_none_are_refused_before_the_work",
        f"{LOOKS}_films",
    ],
    "It connects to nothing": [
        f"{HERE}_the_trial_sees_programs_and_connections",
        "trial/test_clips.py::test_clips_that_were_made",
    ],
    "`view` alone listens": [
        f"{HERE}_the_viewer_listens_on_this_machine_alone",
        f"{HERE}_the_trial_sees_programs_and_connections",
    ],
    "It starts no program": [f"{HERE}_the_trial_sees_programs_and_connections", f"{PHOTOS}_photos_that_were_made"],
    "A signal ends it": [
        "test_parallel.py::test_signals_end_a_wait_for_native_code",
        "test_parallel.py::test_a_library_does_not_take_the_signals",
        "viewer/test_connections.py::test_the_end_of_the_server_ends_a_save",
        f"{CASES}_interrupts",
    ],
    "It answers only pages": [
        "viewer/test_server.py::test_other_sites_may_not_ask",
        "viewer/test_connections.py::test_a_server_for_this_machine_alone_has_no_other_names",
        f"{REQUESTS}_requests_that_are_refused",
    ],
    "Requests have at most": [
        "viewer/test_server.py::test_sizes_are_bounded",
        "viewer/test_connections.py::test_clients_that_never_read_make_room_for_others",
        "viewer/test_connections.py::test_clients_that_never_end_a_request_make_room_for_others",
        f"{REQUESTS}_a_viewer_among_silent_and_deaf_clients",
    ],
    "A save ends when its client leaves": [
        "viewer/test_connections.py::test_a_save_ends_when_its_client_leaves",
        "viewer/test_connections.py::test_a_save_that_would_fill_the_disk_is_refused",
    ],
    "Blocks exchange them": [
        "blocks/test_train.py::test_jobs_exchange_values_in_a_new_folder",
        "trial/test_blocks.py::test_more_plans_of_blocks",
    ],
}
"""Beginnings of sentences, and the functions that hold them."""
TRUSTED = ("The user who types", "TOML presets", "The installed packages")
"""What is trusted is not tested."""


def sentences() -> list[str]:
    text = (ROOT / "SECURITY.md").read_text()
    text = text[: text.index("## Dependencies")]
    points = (" ".join(point.split()) for point in re.findall(r"^- (.*(?:\n  .*)*)", text, re.MULTILINE))
    return [sentence for point in points for sentence in re.split(r"(?<=\.) (?=[A-Z`])", point)]


def test_every_sentence_is_held():
    free = [each for each in sentences() if not each.startswith((*HELD_BY, *TRUSTED))]
    assert not free and all(any(each.startswith(key) for each in sentences()) for key in (*HELD_BY, *TRUSTED)), free


@pytest.mark.parametrize("sentence", HELD_BY)
def test_the_tests_of_a_sentence_are_there(sentence):
    for name in HELD_BY[sentence]:
        file, _, function = name.partition("::")
        assert f"def {function}(" in (ROOT / "tests" / file).read_text(), name


MODULES = {"pickle", "marshal", "shelve", "dill", "joblib"}
UNPICKLES = {"training/ranks.py", "scene/photo_storage.py"}
"""What the processes of one training hand each other."""


def test_no_code_unpickles_or_evaluates():
    for path in sorted((ROOT / "sehdr_warp").rglob("*.py")):
        name = path.relative_to(ROOT / "sehdr_warp").as_posix()
        if name.startswith(("kernels", "configs")):
            continue
        for node in (each for each in ast.walk(ast.parse(path.read_text())) if isinstance(each, ast.Call)):
            called = ast.unparse(node.func)
            options = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            place = f"{name}:{node.lineno}: {called}"
            assert called not in ("eval", "exec", "os.system", "os.popen"), place
            assert called != "torch.load" or options.get("weights_only") == "True", place
            assert called not in ("np.load", "numpy.load") or options.get("allow_pickle", "False") == "False", place
            assert options.get("shell", "False") == "False", place
            assert called.partition(".")[0] not in MODULES or name in UNPICKLES, place


class _Harm:
    def __reduce__(self):
        return Path.touch, (Path("PWNED"),)


def test_pickles_are_refused(tmp_path, monkeypatch):
    """In every format whose library can hold one."""
    monkeypatch.chdir(tmp_path)
    harm = np.array([_Harm()], object)
    (tmp_path / "set").mkdir()
    write_llff(tmp_path / "set")
    np.save(tmp_path / "set" / "poses_bounds.npy", harm, allow_pickle=True)
    (tmp_path / "run").mkdir()
    for name in ("config.json", "run.json", "scene.json", "confidence.safetensors"):
        (tmp_path / "run" / name).write_bytes(pickle.dumps(_Harm()))
    for name in ("squeeze.pth", "squeezenet1_1_features.pth"):
        torch.save({"lin0.model.1.weight": _Harm()}, tmp_path / name)
    for read in (
        lambda: load_scene(tmp_path / "set", response="srgb"),
        lambda: load_run(tmp_path / "run"),
        lambda: load_lpips(tmp_path),
    ):
        with pytest.raises(SehdrError):
            read()
    assert not Path("PWNED").exists()


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "..",
        "a/../../b",
        "C:\\x",
        "\\\\host\\x",
        "..\\x",
        "a\0b",
        "",
        5,
        None,
        "n" * 300,
        "out/x",
        "a/" * 3000,
    ],
)
def test_names_of_a_set_stay_inside(tmp_path, name):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "out").symlink_to(tmp_path)
    with pytest.raises(InputError):
        resolve_inside(tmp_path / "set", name, tmp_path / "set" / "transforms.json")
    assert resolve_inside(tmp_path / "set", "a/b.png", tmp_path).name == "b.png"


def test_the_viewer_listens_on_this_machine_alone():
    assert View(runs=()).host == "127.0.0.1"
    with Server(Viewer([]), port=0) as server:
        assert server.server_address[0] == "127.0.0.1"


def test_the_trial_sees_programs_and_connections(monkeypatch):
    """What the trial's children may not do, by the audit events that Python raises for it."""
    lines = []
    monkeypatch.setattr(harness.os, "write", lambda number, text: lines.append(text))
    monkeypatch.setattr(sys, "argv", ["sehdr-warp", "render"])
    for event, arguments in (
        ("subprocess.Popen", ("/bin/sh", ["sh"])),
        ("os.system", ("ls",)),
        ("os.exec", ("/bin/ls", ["ls"], None)),
        ("socket.connect", (None, ("192.0.2.1", 80))),
        ("socket.bind", (None, ("127.0.0.1", 80))),
        ("socket.getaddrinfo", ("example.org", 80, 0, 0, 0)),
    ):
        lines.clear()
        harness._watch(event, arguments)
        assert lines and lines[0].startswith(b"STARTED"), event
    lines.clear()
    harness._watch("subprocess.Popen", (sys.executable, []))
    harness._watch("socket.connect", (None, ("127.0.0.1", 80)))
    monkeypatch.setattr(sys, "argv", ["sehdr-warp", "view"])
    harness._watch("socket.bind", (None, ("127.0.0.1", 80)))
    assert lines == []
