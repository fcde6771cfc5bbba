"""gsplat's examples/simple_trainer.py (1.5.3) with its rasterizer and strategies replaced.

python -m tests.compat.gsplat.simple_trainer EXAMPLES STRATEGY STEPS [--scene FOLDER] [--device cuda]
    [--engine gsplat] [--seeds 0 1 2]

FOLDER is a set of photos, by default the embedded room. EXAMPLES is the folder `examples` of a checkout of gsplat. Its
file is read as it is; only the name of its device is another on the CPU. What it imports beside gsplat (a viewer,
TensorBoard, metrics, the reader of COLMAP sets) is small here. The output has a line of JSON for each seed: PSNR of the
held-out views and, as psnr_train, of the other views, and how many Gaussians there are.
"""

import argparse
import importlib.util
import json
import sys
import tempfile
import time
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch.nn import functional

import sehdr_warp as sw

POINTS_PER_VIEW = 120
WINDOW, SIGMA = 11, 1.5


class Anything:
    """Takes any call and has any attribute."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> "Anything":
        return self

    def __getattr__(self, name: str) -> "Anything":
        return Anything()

    def to(self, device: Any) -> "Anything":
        return self


def similarity(a: torch.Tensor, b: torch.Tensor, padding: str = "same") -> torch.Tensor:
    """SSIM of images [B, C, H, W]."""
    channels, reach = a.shape[1], WINDOW // 2
    line = torch.exp(-((torch.arange(WINDOW, device=a.device) - reach) ** 2) / (2 * SIGMA**2))
    line = line / line.sum()
    weights = (line[:, None] * line).expand(channels, 1, WINDOW, WINDOW)

    def mean(image: torch.Tensor) -> torch.Tensor:
        return functional.conv2d(image, weights, groups=channels, padding=0 if padding == "valid" else reach)

    mean_a, mean_b = mean(a), mean(b)
    covariance = mean(a * b) - mean_a * mean_b
    variances = mean(a * a) - mean_a**2 + mean(b * b) - mean_b**2
    luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    return (luminance * (2 * covariance + 9e-4) / (variances + 9e-4)).mean()


class Ssim(Anything):
    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return similarity(a, b)


class Psnr(Anything):
    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return -10 * (a - b).square().mean().log10()


class Lpips(Anything):
    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return a.new_zeros(())


class NearestNeighbors:
    def __init__(self, n_neighbors: int, metric: str) -> None:
        self.count = n_neighbors

    def fit(self, points: np.ndarray) -> "NearestNeighbors":
        self.tree = KDTree(points)
        return self

    def kneighbors(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.tree.query(points, self.count)


class Bar:
    def __init__(self, steps: range) -> None:
        self.steps = steps

    def __iter__(self):
        return iter(self.steps)

    def set_description(self, text: str) -> None:
        pass


def camera_to_world(view: sw.View) -> np.ndarray:
    return np.asarray(view.camera.camera_to_world)


def make_parser(scene: sw.Scene):
    """Return the class Parser of gsplat's datasets.colmap, for a scene.

    Its points are those of the scene, or lie along random rays of the photos of a scene without points.
    """
    generator = np.random.default_rng(0)

    class Parser:
        def __init__(self, **_: Any) -> None:
            self.views, self.camtoworlds = scene.views, np.stack([camera_to_world(view) for view in scene.views])
            centers = self.camtoworlds[:, :3, 3]
            self.scene_scale = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
            points, colors = scene.points, scene.point_colors * 255
            if not len(points):
                points, colors = map(np.concatenate, zip(*map(self._rays, scene.views), strict=True))
            self.points, self.points_rgb = points.astype(np.float32), colors.astype(np.uint8)

        def _rays(self, view: sw.View) -> tuple[np.ndarray, np.ndarray]:
            camera, pose = view.camera, camera_to_world(view)
            rows = generator.integers(0, camera.height, POINTS_PER_VIEW)
            columns = generator.integers(0, camera.width, POINTS_PER_VIEW)
            across, down = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
            depths = generator.uniform(0.3, 2.0, (POINTS_PER_VIEW, 1)) * self.scene_scale
            rays = np.stack([across, down, np.ones(POINTS_PER_VIEW)], axis=1) * depths
            return rays @ pose[:3, :3].T + pose[:3, 3], view.image[rows, columns] * 255

    return Parser


class Dataset(torch.utils.data.Dataset):
    """Every eighth view is held out, as there."""

    def __init__(self, parser: Any, split: str = "train", **_: Any) -> None:
        views = [view for place, view in enumerate(parser.views) if (place % 8 == 0) == (split == "val")]
        self.items = [self._item(place, view) for place, view in enumerate(views)]

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, place: int) -> dict[str, Any]:
        return self.items[place]

    def _item(self, place: int, view: sw.View) -> dict[str, Any]:
        camera = view.camera
        matrix = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        pose, image = torch.from_numpy(camera_to_world(view)).float(), torch.from_numpy(view.image * 255)
        return {"K": torch.tensor(matrix), "camtoworld": pose, "image": image.float(), "image_id": place}


def put_module(name: str, **names: Any) -> None:
    module = sys.modules[name] = ModuleType(name)
    module.__spec__ = ModuleSpec(name, None)
    vars(module).update(names)


def put_modules(scene: sw.Scene, engine: str) -> None:
    """Put small modules in the place of those that the file imports."""
    put_module("fused_ssim", fused_ssim=similarity)
    put_module("torchmetrics")
    put_module("torchmetrics.image", PeakSignalNoiseRatio=Psnr, StructuralSimilarityIndexMeasure=Ssim)
    put_module("torchmetrics.image.lpip", LearnedPerceptualImagePatchSimilarity=Lpips)
    put_module("torch.utils.tensorboard", SummaryWriter=Anything)
    put_module("viser", ViserServer=Anything)
    put_module("nerfview", CameraState=Anything, RenderTabState=Anything, apply_float_colormap=None)
    put_module("gsplat_viewer", GsplatViewer=Anything, GsplatRenderTabState=Anything)
    put_module("datasets")
    put_module("datasets.colmap", Parser=make_parser(scene), Dataset=Dataset)
    paths = "generate_ellipse_path_z", "generate_interpolated_path", "generate_spiral_path"
    put_module("datasets.traj", **dict.fromkeys(paths))
    put_module("imageio", imwrite=Anything())
    put_module("yaml", dump=Anything())
    put_module("tqdm", tqdm=Bar)
    put_module("sklearn")
    put_module("sklearn.neighbors", NearestNeighbors=NearestNeighbors)
    if engine == "sehdr":
        from sehdr_warp.compat import gsplat

        put_module("gsplat", export_splats=None)
        put_module("gsplat.compression", PngCompression=None)
        put_module("gsplat.distributed", cli=None)
        put_module("gsplat.optimizers", SelectiveAdam=gsplat.SelectiveAdam)
        put_module("gsplat.rendering", rasterization=gsplat.rasterization)
        put_module("gsplat.strategy", DefaultStrategy=gsplat.DefaultStrategy, MCMCStrategy=gsplat.MCMCStrategy)


def read_trainer(examples: Path, device: str) -> dict[str, Any]:
    """The names of simple_trainer.py."""
    sys.path.insert(0, str(examples))
    source = (examples / "simple_trainer.py").read_text()
    if device == "cpu":
        source = source.replace('f"cuda:{local_rank}"', '"cpu"')
        torch.cuda.synchronize = lambda *_: None
        torch.cuda.max_memory_allocated = lambda *_: 0
    put_module("simple_trainer", __file__="simple_trainer.py")
    names = vars(sys.modules["simple_trainer"])
    exec(compile(source, "simple_trainer.py", "exec"), names)
    load = torch.utils.data.DataLoader
    # In this process: workers take longer to start than short trainings do.
    torch.utils.data.DataLoader = lambda dataset, batch_size, shuffle, **_: load(dataset, batch_size, shuffle)
    return names


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("examples", type=Path)
    parser.add_argument("strategy", choices=["default", "mcmc"])
    parser.add_argument("steps", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--engine", default="sehdr", choices=["sehdr", "gsplat"])
    parser.add_argument("--scene", default="embedded")
    parser.add_argument("--max-size", type=int, default=200)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    args = parser.parse_args()
    put_modules(sw.load_scene(args.scene, max_size=args.max_size), args.engine)
    names, steps = read_trainer(args.examples, args.device), args.steps
    kinds = {"default": names["DefaultStrategy"], "mcmc": names["MCMCStrategy"]}
    refine = {"refine_start_iter": steps // 10, "refine_every": steps // 12, "refine_stop_iter": steps * 7 // 10}
    own: dict[str, Any] = {"cap_max": 20_000} if args.strategy == "mcmc" else {"reset_every": 10 * steps}
    # As the file's own command "mcmc" has them.
    more = {"init_opa": 0.5, "init_scale": 0.1, "opacity_reg": 0.01, "scale_reg": 0.01}
    seed_with = names["set_random_seed"]
    for seed in args.seeds:
        names["set_random_seed"] = lambda rank, seed=seed: seed_with(rank + seed)
        strategy = kinds[args.strategy](**refine, **own)
        result = train(names, strategy, steps, more if args.strategy == "mcmc" else {})
        print(json.dumps(vars(args) | {"examples": None, "seeds": None, "seed": seed} | result), flush=True)


def train(names: dict[str, Any], strategy: Any, steps: int, more: dict[str, float]) -> dict[str, float]:
    """Train as simple_trainer.py does; return what its evaluation says."""
    with tempfile.TemporaryDirectory() as folder:
        config = names["Config"](
            strategy=strategy,
            disable_viewer=True,
            disable_video=True,
            result_dir=folder,
            max_steps=steps,
            eval_steps=[steps],
            save_steps=[],
            tb_every=0,
            sh_degree_interval=max(steps // 5, 1),
            **more,
        )
        runner = names["Runner"](0, 0, 1, config)
        began = time.perf_counter()
        runner.train()
        seconds = time.perf_counter() - began
        result = json.loads(Path(runner.stats_dir, f"val_step{steps - 1:04d}.json").read_text())
        runner.valset = runner.trainset
        runner.eval(steps - 1, stage="train")
        trained = json.loads(Path(runner.stats_dir, f"train_step{steps - 1:04d}.json").read_text())
    return result | {"psnr_train": trained["psnr"], "seconds": seconds}


if __name__ == "__main__":
    assert importlib.util.find_spec("sehdr_warp") is not None
    main()
