"""SECURITY.md, held: every sentence that states what cannot happen names the tests that would notice."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HELD_BY = {
    "Looking at a run changes nothing": "runs/test_run_folder.py::test_reading_changes_nothing "
    "runs/test_run_folder.py::test_only_a_training_finishes_an_interrupted_write",
    "Links inside a run are refused": "runs/test_run_folder.py::test_a_link_is_refused_even_to_a_sound_file "
    "trial/test_strangers.py::test_links_in_a_sent_run",
    "All JSON of a run is checked": "runs/test_run_folder.py::test_a_summary_of_another_shape_is_refused "
    "trial/test_cases.py::test_tampered_runs",
    "What decides the picture": "runs/test_checkpoint.py::test_what_decides_the_picture_is_hashed_with_the_checkpoint",
    "Nothing that is read is run": "trial/test_cases.py::test_hostile_photos fuzz/test_fuzz.py::test_",
    "Text from outside enters HTML escaped": "output/test_report_page.py::test_browsers_run_our_script_and_no_other "
    "output/test_report_page.py::test_no_markup_is_made_but_by_the_one_function",
    "Pictures are decoded by content": "trial/test_cases.py::test_hostile_photos",
    "Sizes and counts are bounded": "trial/test_strangers.py::test_gltf_of_strangers "
    "trial/test_cases.py::test_sparse_files_of_4_gib_are_not_read_whole runs/test_run_folder.py::test_sparse_files",
    "Pipes and devices are not read": "trial/test_cases.py::test_inputs_that_are_pipes_are_not_waited_for",
    "Names in a data set stay inside": "test_files.py::test_",
    "OpenUSD and MATLAB files": "test_sandbox.py::test_bounds test_sandbox.py::test_a_stage_leads_to_no_other_folder "
    "scene/test_video.py::test_counts_beyond_the_file_take_no_memory "
    "scene/test_video.py::test_a_clip_that_names_other_files_is_refused",
    "TOML presets, OpenColorIO configs": "output/test_ocio.py::test_luts_that_cannot_be_read_are_told_in_a_line",
    "It reads the paths": "trial/test_cases.py::test_obstacles_are_kept",
    "It writes only to the paths": "trial/test_strangers.py::test_names_of_output",
    "A file is replaced only": "trial/test_cases.py::test_obstacles_are_kept",
    "A run is replaced only": "trial/test_kills.py::test_training_killed_at_a_change_of_the_disk",
    "A film is one file": "output/test_film.py::test_urls_are_refused "
    "output/test_film.py::test_formats_of_several_files_and_none_are_refused_before_the_work",
    "It connects to nothing": "trial/harness.py::_watch",
    "It starts no program": "trial/harness.py::_watch",
    "A signal ends it": "test_parallel.py::test_signals_end_a_wait_for_native_code "
    "test_parallel.py::test_a_library_does_not_take_the_signals "
    "viewer/test_connections.py::test_the_end_of_the_server_ends_a_save",
    "It answers only pages": "viewer/test_server.py::test_other_sites_may_not_ask "
    "viewer/test_connections.py::test_a_server_for_this_machine_alone_has_no_other_names",
    "Requests have at most": "viewer/test_server.py::test_sizes_are_bounded "
    "viewer/test_connections.py::test_clients_that_never_read_make_room_for_others "
    "viewer/test_connections.py::test_silent_clients_make_room_for_others",
    "A save ends when its client leaves": "viewer/test_connections.py::test_a_save_ends_when_its_client_leaves "
    "viewer/test_connections.py::test_a_save_that_would_fill_the_disk_is_refused",
}
"""Beginnings of sentences, and the functions that hold them."""
TRUSTED = ("The user who types", "The caches", "The installed packages", "The processes of one training")
"""What is trusted is not tested."""


def sentences():
    text = (ROOT / "SECURITY.md").read_text()
    text = text[: text.index("## Dependencies")]
    return [" ".join(item.split()) for item in re.findall(r"^- (.*(?:\n  .*)*)", text, re.MULTILINE)]


def test_every_sentence_is_held():
    free = [each for each in sentences() if not each.startswith((*HELD_BY, *TRUSTED))]
    assert not free and all(any(each.startswith(key) for each in sentences()) for key in (*HELD_BY, *TRUSTED))


@pytest.mark.parametrize("sentence", HELD_BY)
def test_the_tests_of_a_sentence_are_there(sentence):
    for name in HELD_BY[sentence].split():
        file, _, function = name.partition("::")
        assert f"def {function}" in (ROOT / "tests" / file).read_text(), name
