"""The examples, run at small sizes."""

import json
import linecache
import runpy
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def example(name):
    """The variables of an example, run as a file, since Warp reads the source of its kernels."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


def test_quickstart_and_hand_off(tmp_path, few_probes):
    import OpenEXR

    run = example("quickstart")["main"](tmp_path / "first", max_size=32, iterations=8)
    assert run.iterations == 8 and repr(run).startswith("Run(") and "\n" not in repr(run)
    assert len(list((tmp_path / "first" / "views" / "brackets").rglob("*.exr"))) == 5 * len(
        [entry for entry in run.cameras if entry.split == "test"]
    )
    files = example("hand_off")["main"](tmp_path / "first" / "run", tmp_path / "second")
    brackets = [OpenEXR.File(str(file)) for file in files if "brackets" in file.parts]
    times = [file.header()["expTime"] for file in brackets]
    np.testing.assert_allclose(np.array(times) / times[0], [1, 8, 64], rtol=1e-6)
    first, last = np.stack([file.channels()["RGB"].pixels for file in (brackets[0], brackets[-1])]).astype(float)
    assert first.shape == (16, 16, 3) and first.max() > 0
    np.testing.assert_allclose(last, 64 * first, rtol=1e-6)


def notebook(name, **constants):
    """The variables of a notebook whose cells ran one after the other, with other constants than its own."""
    import matplotlib.pyplot as plt

    path, variables = EXAMPLES / f"{name}.ipynb", {"__name__": "__main__"}
    text = json.loads(path.read_text(encoding="utf-8"))
    assert not any(cell.get("outputs") for cell in text["cells"]), f"{path.name} is stored with outputs"
    plt.switch_backend("Agg")
    for place, cell in enumerate(cell for cell in text["cells"] if cell["cell_type"] == "code"):
        source, label = "".join(cell["source"]), f"<{name}, cell {place}>"
        # As a notebook does: Warp reads the source of kernels.
        linecache.cache[label] = len(source), None, source.splitlines(keepends=True), label
        exec(compile(source, label, "exec"), variables)
        if place == 0:
            assert constants.keys() <= variables.keys()
            variables |= constants
    plt.close("all")
    return variables


def test_own_loop(few_probes):
    losses = notebook("own_loop", STEPS=25, MAX_SIZE=32)["losses"]
    assert losses[-1] < 0.6 * losses[0]


def test_own_kernel():
    assert abs(notebook("own_kernel")["density"].item() - 0.35) < 0.005


def test_pose_refinement():
    distances = notebook("pose_refinement", SIZE=48)["distances"]
    assert distances[-1] < 0.1 * distances[0]


def test_relighting(tmp_path):
    pytest.importorskip("mitsuba")
    error = example("relighting")["main"](tmp_path, views=12, size=24, samples=8, iterations=60)
    assert 0 < error < 1 and (tmp_path / "relighting.png").is_file()
