"""Single-image HDR in place of truth: predictors, their files, and that the truth of training views is never seen."""

import dataclasses
import sys
import warnings

import numpy as np
import OpenEXR
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.response import ToneMapper, response_by_name
from sehdr_warp.training.prediction import cross_bilateral, kovaleski_oliveira, predicted_scene
from sehdr_warp.training.train import train

from ..refusals import refused
from .test_train import quick
from .toy import EXPOSURE_TIME


def square(encoded):
    return 3 * encoded * encoded


def torchscript(path, function):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.trace(function, torch.zeros(1, 3, 32, 32)).save(str(path))
    return path


def onnx_square(path):
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    shape = [1, 3, "h", "w"]
    tensors = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("encoded", "linear")]
    three = helper.make_tensor("three", TensorProto.FLOAT, [1], [3.0])
    nodes = [
        helper.make_node("Mul", ["encoded", "encoded"], ["square"]),
        helper.make_node("Mul", ["square", "three"], ["linear"]),
    ]
    graph = helper.make_graph(nodes, "square", tensors[:1], tensors[1:], [three])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path))
    return path


def predictions_folder(folder, scene, value=lambda view: 2 * view.image.astype(np.float32)):
    folder.mkdir()
    for view in scene.train_views:
        write_prediction(folder / f"{view.name}.exr", value(view))
    return folder


def write_prediction(path, pixels):
    # By OpenEXR itself: our own writer refuses what is not finite.
    OpenEXR.File({}, {"RGB": np.ascontiguousarray(pixels, np.float32)}).write(str(path))


def test_the_training_views_get_predictions_and_the_others_keep_their_truth(scene):
    predicted = predicted_scene(scene)
    assert predicted.predictor == "kovaleski-oliveira" and scene.predictor is None
    for view, given in zip(predicted.views, scene.views, strict=True):
        if view.split == "test":
            assert view is given
        else:
            expected = kovaleski_oliveira(given.image, response_by_name("srgb")) / EXPOSURE_TIME
            assert view.hdr.dtype == np.float32 and np.allclose(view.hdr, expected, rtol=1e-5)
            assert view.codes is given.codes


def test_truth_of_training_views_is_never_seen(scene, tmp_path):
    """Whatever the truth says, and whether there is any, a training on predictions is the same."""
    rng = np.random.default_rng(0)
    liars = tuple(
        dataclasses.replace(view, hdr=rng.random(view.hdr.shape, dtype=np.float32)) if view.split == "train" else view
        for view in scene.views
    )
    config = quick("predicted", **{"schedule.iterations": 5})
    runs = [
        train(given, tmp_path / str(number), config, device="cpu")
        for number, given in enumerate((scene, dataclasses.replace(scene, views=liars)))
    ]
    camera = scene.test_views[0].camera
    assert torch.equal(runs[0].render(camera).hdr, runs[1].render(camera).hdr)
    seen = train(scene, tmp_path / "truth", quick("truth", **{"schedule.iterations": 5}), device="cpu")
    assert not torch.equal(seen.render(camera).hdr, runs[0].render(camera).hdr)
    # A scene that holds predictions already keeps them, and a resumed training predicts again.
    other = predicted_scene(scene, torchscript(tmp_path / "square.pt", square))
    run = train(other, tmp_path / "other", config, device="cpu")
    assert not torch.equal(run.render(camera).hdr, runs[0].render(camera).hdr)
    resumed = train(scene, tmp_path / "0", device="cpu", resume=True)
    assert torch.equal(resumed.render(camera).hdr, runs[0].render(camera).hdr)


def test_the_classical_operator_brightens_what_is_clipped_and_little_else():
    encoded = np.full((60, 80, 3), 0.3, dtype=np.float32)
    encoded[20:40, 30:50] = 1.0
    srgb = response_by_name("srgb")
    ratio = kovaleski_oliveira(encoded, srgb) / srgb.decode(encoded.astype(np.float64))
    assert ratio.min() >= 1 and ratio.max() <= 4
    assert ratio[30, 40, 0] > 3.5 and ratio[5, 5, 0] < 1.01
    dull = np.full((60, 80, 3), 0.9, dtype=np.float32)
    assert np.allclose(kovaleski_oliveira(dull, srgb), srgb.decode(dull.astype(np.float64)))


def test_the_cross_bilateral_filter_smooths_within_edges():
    guide = np.zeros((40, 40))
    guide[:, 20:] = 1.0
    noise = np.random.default_rng(1).normal(size=guide.shape)
    smooth = cross_bilateral(guide + noise, guide, 8.0, 0.1)
    assert smooth[10:30, 5:15].std() < 0.15 * noise.std()
    assert abs(smooth[10:30, 5:15].mean()) < 0.2 and abs(smooth[10:30, 25:35].mean() - 1) < 0.2
    assert np.allclose(cross_bilateral(np.full((9, 7), 2.5), guide[:9, :7], 3.0, 0.1), 2.5)


def test_the_response_linearises_and_a_learned_one_does_not(scene):
    dark = predicted_scene(scene, response=response_by_name("linear")).train_views[0].hdr
    bright = predicted_scene(scene).train_views[0].hdr
    assert float(np.median(dark / np.maximum(bright, 1e-6))) > 1.2
    assert np.array_equal(predicted_scene(scene, response=ToneMapper(4)).train_views[0].hdr, bright)


@pytest.mark.parametrize("kind", ["pt", "onnx"])
def test_networks_predict(scene, tmp_path, kind):
    if kind == "onnx":
        pytest.importorskip("onnxruntime")
    made = predicted_scene(
        scene, onnx_square(tmp_path / "square.onnx") if kind == "onnx" else torchscript(tmp_path / "square.pt", square)
    )
    assert np.allclose(made.train_views[0].hdr, 3 * np.square(scene.train_views[0].image) / EXPOSURE_TIME, rtol=1e-5)


def test_a_folder_predicts_by_the_names_of_views_or_photos(scene, tmp_path):
    folder = predictions_folder(tmp_path / "hdr", scene)
    made = predicted_scene(scene, folder)
    assert np.allclose(made.train_views[1].hdr, 2 * scene.train_views[1].image / EXPOSURE_TIME, rtol=1e-5)
    views = tuple(dataclasses.replace(view, name=f"x{view.name}", source=tmp_path / f"{view.name}.png")
                  for view in scene.views)  # fmt: skip
    assert np.array_equal(
        predicted_scene(dataclasses.replace(scene, views=views), folder).views[0].hdr, made.views[0].hdr
    )


@pytest.mark.parametrize(
    "spoil,words",
    [
        (lambda pixels: pixels[:, 1:], ["31 x 32", "32 x 32"]),
        (lambda pixels: np.where(np.arange(32)[:, None, None] == 3, np.nan, pixels), ["not finite"]),
        (lambda pixels: pixels - 1, ["values down to", "not negative"]),
        (np.zeros_like, ["black everywhere"]),
    ],
)
def test_bad_predictions_are_refused_by_file_and_view(scene, tmp_path, spoil, words):
    folder = predictions_folder(tmp_path / "hdr", scene, lambda view: view.image.astype(np.float32))
    write_prediction(folder / "v_2.exr", spoil(scene.views[2].image))
    with pytest.raises(SehdrError) as caught:
        predicted_scene(scene, folder)
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in ["view v_2", "v_2.exr", *words]), message


def test_missing_predictions_are_named(scene, tmp_path):
    folder = predictions_folder(tmp_path / "hdr", scene)
    (folder / "v_4.exr").unlink()
    with pytest.raises(InputError, match=r"no prediction for view v_4 \(v_4.exr, v_4.hdr\)"):
        predicted_scene(scene, folder)


@pytest.mark.parametrize(
    "module,words",
    [
        (lambda encoded: encoded[:, :, 1:], "32 x 31, and the view is 32 x 32"),
        (lambda encoded: encoded - 0.9, "values down to -0"),
        (lambda encoded: (encoded, encoded), "gives tuple"),
    ],
)
def test_networks_of_another_shape_or_range_are_refused(scene, tmp_path, module, words):
    path = torchscript(tmp_path / "net.pt", module)
    with pytest.raises(InputError, match=words) as caught:
        predicted_scene(scene, path)
    assert str(path) in str(caught.value) and "view v_0" in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_no_networks_are_refused(scene, tmp_path, monkeypatch):
    for name, words in (("net.pt", "is not TorchScript"), ("net.bin", "neither TorchScript"), ("none.pt", "no such")):
        if name != "none.pt":
            (tmp_path / name).write_bytes(b"not a network")
        with pytest.raises(InputError, match=words):
            predicted_scene(scene, tmp_path / name)
    (tmp_path / "net.onnx").write_bytes(b"not a network")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=r"net\.onnx: ONNX needs onnxruntime; run `pip install sehdr-warp\[onnx\]`"):
        predicted_scene(scene, tmp_path / "net.onnx")
    monkeypatch.undo()
    pytest.importorskip("onnxruntime")
    with pytest.raises(InputError, match="not a usable ONNX network"):
        predicted_scene(scene, tmp_path / "net.onnx")


def test_the_command_line_takes_predictors(tmp_path, capfd):
    out = tmp_path / "run"
    line = refused(capfd, "train", "embedded", "--out", out, "--device", "cpu", "--predict-hdr", "magic")
    assert line == (
        "sehdr-warp: magic: no such predictor, folder or file; use kovaleski-oliveira, a folder of .exr files, "
        "or a network"
    )
    line = refused(capfd, "train", "embedded", "--out", out, "--preset", "fast", "--predict-hdr", "kovaleski-oliveira")
    assert "loss.predictor = 'kovaleski-oliveira' is for nothing: loss.hdr_weight = 0.0" in line
    (tmp_path / "empty").mkdir()
    flags = ("--device", "cpu", "--max-size", 16, "--iterations", 3)
    line = refused(capfd, "train", "embedded", "--out", out, *flags, "--predict-hdr", tmp_path / "empty")
    assert "holds no prediction for view" in line and not out.exists()
