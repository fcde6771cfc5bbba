"""sehdr-warp: scene-linear HDR Gaussian scenes from photos of one exposure (SeHDR, ICCV 2025).

    import sehdr_warp as sw

    scene = sw.load_scene("photos/")
    run = sw.train(scene, "run/")
    sw.render_views(run, "renders/", cameras="test", evs=(-4, -2, 0, 2, 4))

`__init__.pyi` lists the names, for editors and type checkers too. Each loads its module when it is first used, so
importing the package takes a fraction of a second.
"""

from importlib import import_module

__version__ = "0.3.0"

with open(f"{__file__}i", encoding="utf-8") as _stub:
    _IMPORTS = [line.removeprefix("from .").split(" import ") for line in _stub if line.startswith("from .")]
_HOME_OF = {name: home for home, names in _IMPORTS for name in names.strip().split(", ")}
__all__ = sorted(_HOME_OF)  # noqa: PLE0605 # pyright: ignore[reportUnsupportedDunderAll]


_RENAMED = {
    "Step": "TrainingProgress",
    "Training": "create_trainer",
    "score_folder": "evaluate_folder",
    "write_panorama": "write_environment_map",
}


def __getattr__(name: str):
    if name in _RENAMED:
        raise AttributeError(f"{__name__}.{name} is now {__name__}.{_RENAMED[name]}")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
