"""Single-image HDR in place of truth: each training photo made HDR by itself, by a rule, a network or files.

A prediction is in exposures: 1 is what the predictor takes for the photo's white, and divided by the exposure time it
is radiance. Its scale is the predictor's own.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError, SehdrError
from ..response import Response, response_by_name
from ..scene import Scene, View
from ..scene.hdr_files import read_hdr
from ..scene.images import HDR_SUFFIXES

BUILT_IN = "kovaleski-oliveira"
NETWORK_SUFFIXES = (".pt", ".onnx")
SATURATED = 254 / 255  # A channel at least this bright is taken to be clipped (Rempel et al. 2007, for photos)
BRIGHTEST = 4.0  # The largest enhancement
SPATIAL_SIGMA, RANGE_SIGMA = 150 / 1920, 25 / 255  # Of the filter: in widths of the image, and in encoded values
REC709 = np.array([0.2126, 0.7152, 0.0722])


def check_predictor(name: str | Path) -> None:
    """Raises InputError unless `name` is the built-in one, a folder, or a .pt or .onnx file."""
    path = Path(name)
    if str(name) == BUILT_IN or path.is_dir() or (path.suffix.lower() in NETWORK_SUFFIXES and path.is_file()):
        return
    problem = "is neither TorchScript (.pt) nor ONNX (.onnx)" if path.is_file() else "no such predictor, folder or file"
    raise InputError(name, problem, f"use {BUILT_IN}, a folder of .exr files, or a network")


def predicted_scene(scene: Scene, predictor: str | Path = BUILT_IN, response: Response | None = None) -> Scene:
    """The scene with predictions as the HDR of its training views, whatever truth they had; test views keep theirs.

    predictor: the built-in one; a folder that holds for every training view NAME.exr or NAME.hdr, NAME being the
        view's or its photo's, at the view's size; or a network in TorchScript (.pt) or ONNX (.onnx, needs onnxruntime)
        that takes encoded values [1, 3, H, W] in [0, 1] to linear ones of the same shape.
    response: what linearises the photos for the built-in predictor; by default, and where it is a learned one, sRGB.

    Raises InputError naming file and view for a prediction that is missing, of another size, not finite, negative or
    black; SehdrError where onnxruntime is not installed.
    """
    check_predictor(predictor)
    if response is None or response.learnable:
        response = response_by_name("srgb")
    predict = _predictor(Path(predictor), response)
    views = tuple(_predicted(view, *predict(view)) if view.split == "train" else view for view in scene.views)
    return replace(scene, views=views, predictor=str(predictor))


def kovaleski_oliveira(encoded: np.ndarray, response: Response) -> np.ndarray:
    """Exposures [H, W, 3] from encoded values [H, W, 3] in [0, 1]: linearised, then brighter around what is clipped.

    Source: Kovaleski and Oliveira, High-quality brightness enhancement functions for real-time reverse tone mapping
    (The Visual Computer, 2009): the mask of clipped pixels, smoothed by a cross-bilateral filter that follows the edges
    of the photo's luminance, raises exposures by up to 4. Their noise filter and display levels are left out.
    """
    clipped = (encoded >= SATURATED).any(axis=2).astype(np.float64)
    halo = cross_bilateral(clipped, encoded @ REC709, SPATIAL_SIGMA * encoded.shape[1], RANGE_SIGMA)
    return response.decode(encoded.astype(np.float64)) * (1 + (BRIGHTEST - 1) * halo)[..., None]


def cross_bilateral(values: np.ndarray, guide: np.ndarray, spatial_sigma: float, range_sigma: float) -> np.ndarray:
    """Values [H, W] averaged over pixels near in place and in the guide [H, W], by a bilateral grid of cells of one
    sigma (Paris and Durand 2006; Chen et al. 2007). The sigmas are in pixels (at least 1 is used) and in the guide's
    units."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    rows, columns = np.indices(values.shape) / max(spatial_sigma, 1.0)
    place = np.stack([rows, columns, (guide - guide.min()) / range_sigma])
    shape = tuple(int(axis.max()) + 2 for axis in place)
    cell = np.ravel_multi_index(tuple(np.rint(place).astype(int)), shape).ravel()
    sums = [np.bincount(cell, weights, np.prod(shape)).reshape(shape) for weights in (values.ravel(), None)]
    total, weight = (gaussian_filter(grid.astype(np.float64), 1.0, mode="constant") for grid in sums)
    total, weight = (map_coordinates(grid, place, order=1) for grid in (total, weight))
    return total / np.maximum(weight, 1e-12)


def _predictor(path: Path, response: Response) -> Callable[[View], tuple[Path, np.ndarray]]:
    """From a view to where its prediction comes from, and the prediction [H, W, 3]."""
    if str(path) == BUILT_IN:
        return lambda view: (path, kovaleski_oliveira(view.image, response))
    if path.is_dir():
        return lambda view: _from_folder(path, view)
    network = _torchscript(path) if path.suffix.lower() == ".pt" else _onnx(path)
    return lambda view: (path, _through_network(network, path, view))


def _predicted(view: View, source: Path, prediction: np.ndarray) -> View:
    """The view with a sound prediction as its HDR; InputError for another."""
    problem = None
    if prediction.shape != view.codes.shape:
        problem = f"is {_size(prediction)}, and the view is {_size(view.codes)}"
    elif not np.isfinite(prediction).all():
        problem = f"has {int((~np.isfinite(prediction)).any(axis=2).sum())} pixels that are not finite"
    elif prediction.min() < 0:
        problem = f"has values down to {prediction.min():.4g}; light is not negative"
    elif prediction.max() == 0:
        problem = "is black everywhere"
    if problem:
        raise InputError(source, f"its prediction for view {view.name} {problem}", "correct or replace the predictor")
    return replace(view, hdr=(prediction / view.exposure_time).astype(np.float32))


def _from_folder(folder: Path, view: View) -> tuple[Path, np.ndarray]:
    stems = dict.fromkeys([view.name, *([] if view.source is None else [view.source.stem])])
    tried = [folder / f"{stem}{suffix}" for stem in stems for suffix in HDR_SUFFIXES]
    path = next((path for path in tried if path.is_file()), None)
    if path is None:
        names = ", ".join(path.name for path in tried)
        remedy = "predict every training view, and name the file as the view"
        raise InputError(folder, f"holds no prediction for view {view.name} ({names})", remedy)
    try:
        return path, read_hdr(path, keep_negative=True)
    except InputError as error:
        raise SehdrError(f"view {view.name}: {error}") from None


def _through_network(network: Callable, path: Path, view: View) -> np.ndarray:
    """The network's output for a view as [H, W, 3]; InputError if it fails or gives another shape."""
    encoded = np.ascontiguousarray(view.image.transpose(2, 0, 1)[None])
    remedy = "it must take [1, 3, H, W] to [1, 3, H, W]"
    try:
        output = network(encoded)
    # Whatever a network raises, a user wants to know which network and which view.
    except Exception as error:  # noqa: BLE001
        problem = f"fails on view {view.name}, {_size(view.codes)} ({_reason(error, -1)})"
        raise InputError(path, problem, remedy) from None
    if not isinstance(output, np.ndarray) or output.shape[:2] != (1, 3) or output.ndim != 4:
        found = list(output.shape) if isinstance(output, np.ndarray) else type(output).__name__
        raise InputError(path, f"gives {found} for view {view.name}, not {list(encoded.shape)}", remedy)
    return output[0].transpose(1, 2, 0)


def _torchscript(path: Path) -> Callable:
    import warnings

    import torch

    try:
        with warnings.catch_warnings():
            # torch would have TorchScript replaced; networks that exist are stored in it.
            warnings.simplefilter("ignore", DeprecationWarning)
            module = torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise InputError(path, f"is not TorchScript ({_reason(error)})", "save it with torch.jit.save") from None

    @torch.no_grad()
    def run(encoded: np.ndarray):
        output = module(torch.from_numpy(encoded))
        return output.float().cpu().numpy() if isinstance(output, torch.Tensor) else output

    return run


def _onnx(path: Path) -> Callable:
    try:
        import onnxruntime
    except ImportError:
        raise InputError(path, "ONNX needs onnxruntime", "run `pip install sehdr-warp[onnx]`") from None
    try:
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    # onnxruntime's own exceptions have no common base but this.
    except Exception as error:  # noqa: BLE001
        raise InputError(path, f"is not a usable ONNX network ({_reason(error)})", "export it again") from None
    name = session.get_inputs()[0].name
    return lambda encoded: session.run(None, {name: encoded})[0]


def _reason(error: Exception, line: int = 0) -> str:
    return (str(error).strip().splitlines() or [repr(error)])[line][:200]


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
