"""sehdr-warp: scene-linear HDR Gaussian scenes from photos of one exposure (SeHDR, ICCV 2025).

    import sehdr_warp as sw

    scene = sw.load_scene("photos/")
    run = sw.train(scene, "run/", sw.load_config("fast"))
    sw.render_views(run, "renders/", cameras="test", evs=(-4, -2, 0, 2, 4))

Names load their modules when they are first used, so importing the package costs next to nothing.
"""

from importlib import import_module

__version__ = "0.1.0"

_HOMES = {
    "Camera": "scene",
    "View": "scene",
    "Scene": "scene",
    "load_scene": "scene",
    "Config": "training.config",
    "load_config": "training.config_files",
    "train": "training.train",
    "Run": "training.run",
    "load_run": "training.run",
    "render_views": "output.render_views",
    "write_brackets": "output.brackets",
    "evaluate": "evaluation.evaluate",
    "rasterize": "splatting",
    "SehdrError": "errors",
    "InputError": "errors",
}

__all__ = sorted(_HOMES)  # noqa: PLE0605


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
