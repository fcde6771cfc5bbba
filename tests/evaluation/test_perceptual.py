"""LPIPS: published figures with the real weights, and every way in which weights can be absent or wrong."""

import pickle
import shutil

import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.evaluation.perceptual import load_lpips, squeezenet_features


@pytest.fixture(scope="module")
def made_up(tmp_path_factory):
    """A folder with weights of the right shapes and random values."""
    folder = tmp_path_factory.mktemp("lpips")
    torch.manual_seed(0)
    torch.save(squeezenet_features().state_dict(), folder / "squeezenet1_1_features.pth")
    widths = (64, 128, 256, 384, 384, 512, 512)
    heads = {f"lin{i}.model.1.weight": torch.rand(1, width, 1, 1) for i, width in enumerate(widths)}
    torch.save(heads, folder / "squeeze.pth")
    return folder


@pytest.fixture(autouse=True)
def no_variable(monkeypatch):
    monkeypatch.delenv("SEHDR_LPIPS", raising=False)


def test_published_figures(shared):
    """The example in torchmetrics' documentation (net_type="squeeze", reduction="none", seed 42)."""
    real, _ = load_lpips(shared / "lpips")
    generator = torch.Generator().manual_seed(42)
    first, second = (torch.rand(2, 3, 100, 100, generator=generator).permute(0, 2, 3, 1) for _ in range(2))
    assert [real(a, b) for a, b in zip(first, second)] == pytest.approx([0.1024, 0.0938], abs=5e-5)


def test_the_environment_names_the_folder(made_up, monkeypatch):
    assert load_lpips()[0] is None and "SEHDR_LPIPS" in load_lpips()[1]
    monkeypatch.setenv("SEHDR_LPIPS", str(made_up))
    metric, reason = load_lpips()
    a, b = torch.rand(40, 33, 3), torch.rand(40, 33, 3)
    assert reason is None and metric(a, a) == 0 and metric(a, b) > 0


def test_torchvisions_own_file_serves_as_backbone(made_up, tmp_path):
    shutil.copy(made_up / "squeeze.pth", tmp_path)
    state = torch.load(made_up / "squeezenet1_1_features.pth", weights_only=True)
    whole = {f"features.{name}": value for name, value in state.items()} | {"classifier.1.weight": torch.zeros(3)}
    torch.save(whole, tmp_path / "squeezenet1_1-b8a52dc0.pth")
    a, b = torch.rand(32, 32, 3), torch.rand(32, 32, 3)
    assert load_lpips(tmp_path)[0](a, b) == load_lpips(made_up)[0](a, b)


@pytest.mark.parametrize("files, missing", [("squeeze.pth", "backbone"), ("squeezenet1_1_features.pth", "squeeze.pth")])
def test_an_incomplete_folder_is_a_reason(made_up, tmp_path, files, missing):
    shutil.copy(made_up / files, tmp_path)
    metric, reason = load_lpips(tmp_path)
    assert metric is None and missing in reason
    with pytest.raises(InputError, match="does not exist"):
        load_lpips(tmp_path / "nowhere")


class _Payload:
    """A pickle that would create a file."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return (open, (str(self.file), "w"))


@pytest.mark.parametrize("name", ["squeeze.pth", "squeezenet1_1_features.pth"])
@pytest.mark.parametrize("content", ["text", "truncated", "pickle", "list", "other shapes"])
def test_damaged_and_hostile_files_are_named(made_up, tmp_path, name, content):
    folder = tmp_path / "weights"
    shutil.copytree(made_up, folder)
    file = folder / name
    if content == "text":
        file.write_text("not weights")
    elif content == "truncated":
        file.write_bytes(file.read_bytes()[:1000])
    elif content == "pickle":
        file.write_bytes(pickle.dumps(_Payload(tmp_path / "ran"), protocol=2))
    elif content == "list":
        torch.save([torch.zeros(3)], file)
    else:
        state = torch.load(file, weights_only=True)
        torch.save({key: value.flatten()[:5] for key, value in state.items()}, file)
    with pytest.raises(InputError, match=name):
        load_lpips(folder)
    assert not (tmp_path / "ran").exists()


def test_images_too_small_for_the_network_are_refused(made_up):
    metric, _ = load_lpips(made_up)
    assert metric(torch.rand(17, 17, 3), torch.rand(17, 17, 3)) > 0
    with pytest.raises(ValueError, match="17"):
        metric(torch.rand(16, 40, 3), torch.rand(16, 40, 3))
