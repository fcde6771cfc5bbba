"""Export and convert as typed: refusals before a scene is read."""

import sys
from pathlib import Path

import pytest

from sehdr_warp.errors import InputError, SehdrError, UsageError
from sehdr_warp.output.commands import Render, ViewFileOptions, run_render
from sehdr_warp.output.export.commands import Convert, Export, run_convert, run_export


def test_a_wrong_suffix_gets_a_line_with_all_that_export_writes(tmp_path):
    with pytest.raises(InputError, match=r"scene: is not a splat file; use one of \.ply .* \.glb .* \.html$"):
        run_export(Export(run=tmp_path, out=tmp_path / "scene"))
    with pytest.raises(InputError, match=r"holds 8 bits .* \.html$"):
        run_export(Export(run=tmp_path, out=tmp_path / "scene.splat"))


def test_what_is_refused_is_refused_before_the_scene_is_read(tmp_path, monkeypatch):
    (tmp_path / "damaged.ply").write_text("ply")
    for name in ("a.ply", "a.html", "a.glb.cameras.json"):
        (tmp_path / name).write_text("mine")
    for name in ("a.ply", "a.html", "a.glb"):
        with pytest.raises(InputError, match="exists already"):
            run_export(Export(run=tmp_path / "damaged.ply", out=tmp_path / name, cameras=name == "a.glb"))
    with pytest.raises(InputError, match="exists already"):
        run_convert(Convert(source=tmp_path / "damaged.ply", out=tmp_path / "a.ply"))
    with pytest.raises(SehdrError, match="^multipart: brackets need exposures"):
        run_render(Render(run=tmp_path / "damaged.ply", out=tmp_path, pictures=ViewFileOptions(multipart=True)))
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(SehdrError, match="OpenUSD is not installed; run `pip install"):
        run_export(Export(run=tmp_path / "damaged.ply", out=tmp_path / "new.usda"))


def test_words_that_people_type_find_what_they_mean(tmp_path):
    with pytest.raises(UsageError, match="pages are written by sehdr-warp export 'my head.ply' --out x.html"):
        run_convert(Convert(source=Path("my head.ply"), out=Path("x.html")))
    with pytest.raises(InputError, match="head.splat: .splat is not read"):  # Nor by export
        run_convert(Convert(source=Path("head.splat"), out=Path("x.html")))
    with pytest.raises(UsageError, match="is a folder; runs are written by sehdr-warp export"):
        run_convert(Convert(source=tmp_path, out=tmp_path / "x.ply"))
    with pytest.raises(UsageError, match="meshes are written by sehdr-warp mesh 'my runs/a' --out files/x.usdc"):
        run_export(Export(run=Path("my runs/a"), out=Path("files/x.obj")))
