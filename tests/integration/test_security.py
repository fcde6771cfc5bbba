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
HELD_BY = """
Looking at a run changes nothing: reading_changes_nothing
Only a training that holds: only_a_training_finishes_an_interrupted_write two_trainings_do_not_mix
    locks_that_are_no_locks
Links inside a run are refused: a_link_is_refused_even_to_a_sound_file links_that_a_user_made
    links_in_the_run_are_not_followed
All JSON of a run is checked: a_summary_of_another_shape_is_refused tampered_runs
    what_is_not_an_object_is_refused
What decides the picture: what_decides_the_picture_is_hashed_with_the_checkpoint
The hash finds damage: a_damaged_newest_falls_back tampered_runs
It is no signature: tampered_runs
Nothing that is read is run or unpickled: no_code_unpickles_or_evaluates pickles_are_refused
    other_formats_and_colors_are_refused_and_no_program_is_started
Text from outside enters HTML escaped: browsers_run_our_script_and_no_other no_markup_is_made_but_by_the_one_function
    names_of_photos_on_pages_and_terminals
Control characters from outside: a_terminal_obeys_nothing_of_what_files_say names_in_lists_on_terminals
Pictures are decoded by content: other_formats_and_colors_are_refused_and_no_program_is_started photos_that_were_made
Sizes and counts are bounded: sparse_files_of_4_gib_are_not_read_whole splats opcodes_of_dng sparse_files_are_not_read
    a_sparse_checkpoint_is_refused_by_its_length tensors_of_a_run
    a_small_index_takes_no_memory_that_its_chunks_do_not_state parts_of_an_item_that_overlap_take_no_memory
Pipes and devices are not read: inputs_that_are_pipes_are_not_waited_for devices_and_pipes_are_not_read
What has the name of a run's or a set's file: what_has_the_name_of_a_file_is_not_taken_for_a_missing_one
    kinds_of_files_of_a_run kinds_of_files_of_a_set
Environment variables of a launcher: numbers_that_no_launcher_sets_are_refused ports_that_cannot_be_are_refused
    times_that_cannot_be_are_refused environments
Names in a data set stay inside: names_of_a_set_stay_inside links_that_lead_out_of_a_set
    folders_that_lead_out_of_the_set_are_not_searched the_folder_of_photos_may_be_a_link
OpenUSD and MATLAB files, and videos: bounds counts_beyond_the_file_take_no_memory
A stage that refers to files: a_stage_leads_to_no_other_folder a_clip_that_names_other_files_is_refused
    clips_that_were_made
LUTs of a config must be files: luts_that_cannot_be_read_are_named_in_a_line luts_that_were_made archives_of_configs
The caches: damaged_modules_go_and_are_logged_once frames_are_kept_in_the_cache
The processes of one training: ranks_stay_alike_and_one_can_go_on
It reads the paths: what_commands_open
It writes only to the paths: names_of_output what_commands_open
A file is replaced only: obstacles_are_kept existing_file_is_kept_unless_asked
Links, devices and pipes are never: links_devices_and_pipes_are_never_replaced
A run is replaced only: training_killed_at_a_change_of_the_disk
A film is one file: urls_are_refused formats_of_several_files_and_none_are_refused_before_the_work
It connects to nothing: the_trial_sees_programs_and_connections clips_that_were_made
`view` alone listens: the_viewer_listens_on_this_machine_alone the_trial_sees_programs_and_connections
It starts no program: the_trial_sees_programs_and_connections photos_that_were_made
A signal ends it: signals_end_a_wait_for_native_code a_library_does_not_take_the_signals
    the_end_of_the_server_ends_a_save interrupts
It answers only pages: other_sites_may_not_ask a_server_for_this_machine_alone_has_no_other_names
    requests_that_are_refused
Requests have at most: sizes_are_bounded clients_that_never_read_make_room_for_others
    clients_that_never_end_a_request_make_room_for_others a_viewer_among_silent_and_deaf_clients
A save ends when its client leaves: a_save_ends_when_its_client_leaves a_save_that_would_fill_the_disk_is_refused
Blocks exchange them: jobs_exchange_values_in_a_new_folder plans_of_blocks
"""
"""Beginnings of sentences, and the tests that hold them, without test_."""
TRUSTED = ("The user who types", "TOML presets", "The installed packages")  # What is trusted is not tested


def sentences() -> list[str]:
    text = (ROOT / "SECURITY.md").read_text()
    text = text[: text.index("## Dependencies")]
    points = (" ".join(point.split()) for point in re.findall(r"^- (.*(?:\n  .*)*)", text, re.MULTILINE))
    return [sentence for point in points for sentence in re.split(r"(?<=\.) (?=[A-Z`])", point)]


def test_every_sentence_is_held():
    held = dict(line.split(": ") for line in HELD_BY.replace("\n    ", " ").strip().splitlines())
    free = [each for each in sentences() if not each.startswith((*held, *TRUSTED))]
    assert not free and all(any(each.startswith(key) for each in sentences()) for key in (*held, *TRUSTED)), free
    source = "".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    missing = {name for names in held.values() for name in names.split() if f"def test_{name}(" not in source}
    assert not missing, f"no tests of these names: {missing}"


MODULES = {"pickle", "marshal", "shelve", "dill", "joblib"}
UNPICKLES = {"training/ranks.py", "scene/photo_storage.py"}  # What the processes of one training hand each other


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
    """Try every format whose library can hold one."""
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


OUTSIDE = ["/etc/passwd", "..", "a/../../b", "out/x", "C:\\x", "\\\\host\\x", "..\\x"]
OUTSIDE += ["a\0b", "", 5, None, "n" * 300, "a/" * 3000]


@pytest.mark.parametrize("name", OUTSIDE)
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
    """Check what the trial's processes may not do, by the audit events that Python raises for it."""
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
