"""Every reader of files, with small real files to start from."""

import gzip
import hashlib
import json
import os
import shutil
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.io import savemat

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.confidence import Evidence
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.output.camera_exchange import usd_cameras
from sehdr_warp.output.exr import Part, write_exr, write_multipart_exr
from sehdr_warp.output.ocio import ocio_view
from sehdr_warp.output.world_transform import WorldTransform
from sehdr_warp.own_files import LIST
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.run import assemble_field, load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.run_writer import RunWriter, write_confidence
from sehdr_warp.runs.values import FORMAT
from sehdr_warp.scene import load_cameras, load_scene
from sehdr_warp.scene.colmap_model import read_ply_points
from sehdr_warp.scene.color_encoding import stated_encoding
from sehdr_warp.scene.exposure import exif_exposure
from sehdr_warp.scene.gain_map import has_gain_map, light_of, read_gain_map
from sehdr_warp.scene.hdr_files import hdr_size, read_exr_channels, read_hdr
from sehdr_warp.scene.images import open_image
from sehdr_warp.scene.linear_photos import color_matrix, raw_exposure
from sehdr_warp.scene.masks import read_mask
from sehdr_warp.scene.photos import photo_sizes, read_photo
from sehdr_warp.scene.read_folders import read_colmap, read_hdr_nerf_real, read_llff
from sehdr_warp.scene.read_opensfm import read_opensfm
from sehdr_warp.scene.read_transforms import read_hdr_nerf, read_transforms
from sehdr_warp.scene.video import codes, decode, open_clip
from sehdr_warp.scene.video_frames import choose_frames
from sehdr_warp.splats import LOSSY_SUFFIXES, USD_SUFFIXES, GaussianArrays, read_gaussians, write_gaussians
from sehdr_warp.synth.expose import RadianceView
from sehdr_warp.training.train import create_trainer
from sehdr_warp.training.trainer import Trainer
from tests.make_scenes import pattern, write_blender, write_colmap, write_llff, write_reinhard
from tests.output.helpers import camera
from tests.scene.clips import pan, write_clip
from tests.scene.dng_files import area, gain_map, mosaic, opcodes, write_tagged_dng
from tests.scene.gain_map_files import iso_metadata, write_heif_pair, write_jpeg_pair, xmp_segment
from tests.scene.raw_files import write_dng
from tests.scene.test_color_encoding import icc_profile
from tests.training.toy import orbit_camera, toy_scene


@dataclass(frozen=True)
class Reader:
    """make: writes the files into an empty folder. files: globs of those that are mutated. read: what is tried, on the
    folder; on the mutated file where it is of each().

    text: the files are text. repair: after a mutation, makes good what would otherwise hide the reader behind it (a
    checksum, a length). cost: milliseconds an input, by which inputs are shared out.
    """

    make: Callable[[Path], None]
    files: tuple[str, ...]
    read: Callable[[Path], object]
    text: bool = False
    repair: Callable[[Path], None] | None = None
    cost: float = 1.0


def each(*readers: Callable[[Path], object]) -> Callable[[Path], None]:
    """Tries every reader on a file, though some raise: the first error is raised at the end."""

    def read_all(path: Path) -> None:
        problem = None
        for read in readers:
            try:
                read(path)
            except SehdrError as error:
                problem = problem or error
        if problem:
            raise problem

    read_all.alone = True
    return read_all


def _colmap(binary: bool) -> Callable[[Path], None]:
    return lambda folder: write_colmap(folder, 4, binary=binary, size=(24, 16), params=(20.0, 21.0, 12.0, 8.0))


def _transforms(folder: Path) -> None:
    write_blender(folder, 4, size=(16, 12), fl_x=20.0, fl_y=20.0, w=16, h=12, k1=0.01, train_filenames=["images/r_0"])


def _hdr_nerf(folder: Path) -> None:
    view = orbit_camera(0.0, 16)
    radiance = [np.full((16, 16, 3), 0.1 * i + 0.1) for i in (0, 1)]
    views = [RadianceView(f"r_{i}", view, radiance[i], ("train", "test")[i]) for i in (0, 1)]
    write_reinhard(folder, views, [0.5, 2.0], points=(np.eye(3), np.eye(3)))


def _exposures(folder: Path) -> None:
    _colmap(False)(folder)
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "exposures.json").write_text(json.dumps({name: 0.01 * (i + 1) for i, name in enumerate(names)}))


def _points(folder: Path) -> None:
    rows = np.zeros(6, [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for name, text in (("binary", False), ("text", True)):
        PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(folder / f"{name}.ply"))


def _exr(folder: Path) -> None:
    pixels = np.linspace(0, 3, 8 * 6 * 3, dtype=np.float32).reshape(6, 8, 3)
    channels = {name: pixels[..., i] for i, name in enumerate("RGB")}
    write_exr(folder / "half.exr", channels)
    write_exr(folder / "float.exr", channels, pixel="float")
    write_multipart_exr(folder / "parts.exr", [Part(channels, name="a"), Part(channels, name="b")])


def _radiance(folder: Path) -> None:
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2.0\n\n-Y 4 +X 9\n"
    row = b"\x02\x02\x00\x09" + (b"\x89\x40" + b"\x89\x50" + b"\x09abcdefghi" + b"\x89\x81")
    (folder / "coded.hdr").write_bytes(header + row * 4)
    (folder / "flat.hdr").write_bytes(header.replace(b"X 9", b"X 3") + bytes(range(120, 168)))


def _photos(folder: Path) -> None:
    picture = Image.fromarray(pattern(12, 10))
    tags = Image.Exif()
    tags[0x0112] = 6
    tags.get_ifd(0x8769)[33434] = 0.01
    for name in ("a.jpg", "a.png", "a.tif"):
        picture.save(folder / name, exif=tags)
    picture.save(folder / "a.webp")
    picture.convert("RGBA").save(folder / "b.png")
    picture.convert("P").save(folder / "c.png")
    picture.save(folder / "a.bmp")
    Image.fromarray(np.arange(120, dtype=np.uint16).reshape(10, 12)).save(folder / "d.png")


def _config(folder: Path) -> None:
    (folder / "own.toml").write_text('base = "paper"\nseed = 3\n[schedule]\niterations = 100\nevaluate_at = [1, 2]\n')
    (folder / "all.toml").write_text((resources.files("sehdr_warp.configs") / "default.toml").read_text())


PLAN = {"decisions": [{"name": "brackets", "choice": "plain scaling", "reason": "8 bits", "fields": {"seed": 3}}]}
REGION = {"photo": "r_0", "pixels": 9, "column": 3.0, "row": 4.0, "stops": 1.5, "box": [1, 2, 3, 4]}
SUMMARY = {"iteration": 10, "train_seconds": 2.0, "finished": True, "gaussians": 4, "device": "cpu (1 threads)"}
SUMMARY |= {"plan": {"brackets": "plain"}, "unexplained": {"regions": 1, "photos": 1, "worst": [REGION]}}


def _run(folder: Path) -> None:
    config = load_config("paper", {"schedule.iterations": 10})
    gaussians = Gaussians.from_points(torch.rand(4, 3), torch.zeros(4, 3), 3)
    scene = toy_scene(2, 8)
    field = assemble_field(gaussians, config, response_by_name("srgb"), 0.25)
    run = RunWriter(folder)
    tensors, values = Trainer(scene, config, field).state()
    run.begin(scene, config, field, {"path": "embedded"}, PLAN, (tensors, values | {"seconds": 1.0}))
    run.unlock()
    run.append_metrics({"iteration": 1, "seconds": 0.5, "psnr_ldr": 20.0})
    run.write_summary(SUMMARY)


def _read_run(folder: Path):
    run = load_run(folder)
    return run.metrics(), run.summary(), run.decisions(), run.degree


def _confidence(folder: Path) -> None:
    _run(folder)
    checkpoint = RunFolder(folder).newest_checkpoint()
    write_confidence(RunFolder(folder), Evidence(*torch.rand(4, 4)), checkpoint.values["sha256"])


def _read_confidence(folder: Path):
    return load_run(folder).clipped_share()


def _resume(folder: Path):
    return create_trainer(toy_scene(2, 8), folder, device="cpu", resume=True)


def _resign(folder: Path) -> None:
    for path in folder.glob("checkpoints/*/checkpoint.json"):
        with suppress(OSError, ValueError, TypeError, RecursionError, SehdrError):
            values = json.loads(path.read_bytes())
            data = (path.parent / "state.safetensors").read_bytes()
            hashes = {"sha256": hashlib.sha256(data).hexdigest(), "run": RunFolder(folder).hashes()}
            path.write_text(json.dumps(values | hashes))


def _responses(folder: Path) -> None:
    x = np.linspace(0, 1, 9)
    y = x**0.5
    row = " ".join(f"{v:.4f}" for v in x)
    curve = " ".join(f"{v:.4f}" for v in y)
    (folder / "c.csv").write_text("exposure,value\n" + "".join(f"{a},{b}\n" for a, b in zip(x, y)))
    (folder / "c.json").write_text(json.dumps({"exposures": x.tolist(), "values": y.tolist()}))
    stored = {"kind": "table", "name": "n", "exposures": x.tolist(), "values": y.tolist(), "notes": []}
    (folder / "d.json").write_text(json.dumps(stored))
    (folder / "dorf.txt").write_text("".join(f"n{i}\nkind\nI =\n{row}\nB =\n{curve}\n" for i in range(2)))
    (folder / "emor.txt").write_text(f"E =\n{row}\nf0 =\n{curve}\nh(1)=\n{row}\n")
    savemat(folder / "m.mat", {"B": np.stack([y, y]), "I": np.stack([x, x])})


def _curves(folder: Path) -> None:
    _responses(folder)
    (folder / "m.mat").unlink()


def _read_response(path: Path):
    selectors = {"dorf.txt": ":1", "emor.txt": ":0.1", "m.mat": ":0"}
    curve = response_by_name(f"{path}{selectors.get(path.name, '')}")
    return curve.decode(curve.encode(np.array([0.0, 0.2, 3.0]))), curve.white


def _cameras(folder: Path) -> None:
    view = camera(16, 12).to_dict()
    (folder / "own.json").write_text(json.dumps({"cameras": [{"name": "a", **view}, {"camera": view}]}))
    path = [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50}]
    (folder / "studio.json").write_text(json.dumps({"render_width": 8, "render_height": 6, "camera_path": path}))


def _cameras_of_others(folder: Path) -> None:
    place = {"rotation": np.eye(3).tolist(), "position": [0, 0, 1]}
    listed = [{"id": 0, "img_name": "a", "width": 16, "height": 12, "fx": 20.0, "fy": 20.0, **place}]
    (folder / "inria.json").write_text(json.dumps(listed))
    _transforms(folder)
    _cameras(folder)
    back = {"transform": np.eye(4)[:3].tolist(), "scale": 0.5}
    (folder / "dataparser_transforms.json").write_text(json.dumps(back))
    shutil.rmtree(folder / "images")


def _splats(*suffixes: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        arrays = [np.full((3, *shape), 0.25, np.float32) for shape in ((3,), (3,), (4,), (), (4, 3))]
        for suffix in suffixes:
            write_gaussians(
                folder / f"a{suffix}",
                GaussianArrays(*arrays, "display" if suffix in (".glb", *LOSSY_SUFFIXES) else "linear", 0.5),
            )
        if ".usda" in suffixes:
            (folder / "b.usda").write_text(
                usd_cameras([("a", camera(16, 12)), ("b", camera(8, 8))], WorldTransform.identity())
            )
        (folder / LIST).unlink()

    return make


def _rechunk(folder: Path) -> None:
    """Lengths of a GLB's chunks that fit again."""
    data = (folder / "a.glb").read_bytes()
    end = data.find(b"BIN\0") - 4
    if end > 20:
        data = data[:8] + struct.pack("<2I", len(data), end - 20) + data[16:]
        (folder / "a.glb").write_bytes(data)


def _read_usd(path: Path):
    return (load_cameras if path.name == "b.usda" else read_gaussians)(path)


def _raw(folder: Path) -> None:
    write_dng(folder / "a.dng", np.linspace(0, 1, 32 * 24 * 3).reshape(24, 32, 3))


def _load(folder: Path):
    return load_scene(folder, response="srgb")


def _read_photo(path: Path):
    return read_photo(path, oriented=True)


def _read_matrix(path: Path):
    return color_matrix([path])


def _llff(folder: Path) -> None:
    write_llff(folder, 4, size=(16, 12))


def _llff_seconds(folder: Path) -> None:
    _llff(folder)
    (folder / "images").rename(folder / "input_images")
    for number, path in enumerate(sorted((folder / "input_images").iterdir())):
        path.rename(path.with_name(f"{number:03d}_0.png"))
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds_exps.npy", np.c_[rows, np.full(len(rows), 0.5)])


def _heif(folder: Path, name: str, pixels: np.ndarray, **options) -> Path:
    """A photo as .heic or .avif."""
    image = Image.fromarray(pixels)
    if name.endswith(".avif"):
        image.save(folder / name, quality=90, **options)
    else:
        import pillow_heif

        pillow_heif.from_pillow(image).save(folder / name, quality=90, **options)
    return folder / name


def _gain_maps(folder: Path) -> None:
    base, gain = pattern(16, 12), pattern(8, 6)[..., 0]
    iso = 0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + iso_metadata(2.5, channels=3)
    write_jpeg_pair(folder / "iso.jpg", base, gain, [iso])
    write_jpeg_pair(folder / "xmp.jpg", base, gain, [xmp_segment({"GainMapMax": "2.5", "HDRCapacityMax": "2.5"})])
    apple = xmp_segment({"HDRGainMapHeadroom": "4"}, "HDRGainMap", "http://ns.apple.com/HDRGainMap/1.0/")
    write_jpeg_pair(folder / "apple.jpg", base, gain, [apple])
    for suffix in (".heic", ".avif"):
        files = [_heif(folder, f"{n}{suffix}", p) for n, p in (("b", base), ("g", np.repeat(gain[..., None], 3, 2)))]
        write_heif_pair(folder / f"iso{suffix}", *files, iso=iso_metadata(2.5))
        if suffix == ".heic":
            write_heif_pair(folder / "apple.heic", *files, apple_xmp=apple[1].partition(b"\0")[2])
        for file in files:
            file.unlink()


def _read_light(path: Path):
    found = read_gain_map(path, oriented=True)
    return has_gain_map(path), light_of(read_photo(path), found) if found is not None else None


def _heic(folder: Path) -> None:
    tags = Image.Exif()
    tags[0x0112] = 6
    tags.get_ifd(0x8769)[33434] = 0.01
    for name in ("a.heic", "a.avif"):
        _heif(folder, name, pattern(16, 12), exif=tags.tobytes())
    import pillow_heif

    deep = np.linspace(0, 65535, 16 * 12 * 3).astype(np.uint16)
    pillow_heif.from_bytes("RGB;16", (16, 12), deep.tobytes()).save(folder / "deep.heic", quality=90)


def _icc(folder: Path) -> None:
    (folder / "matrix.icc").write_bytes(icc_profile("Display P3"))
    (folder / "gamma.icc").write_bytes(icc_profile("Adobe RGB (1998)", 2.2))
    table = b"curv\0\0\0\0" + struct.pack(">I9H", 9, *range(0, 65536, 8191))
    (folder / "table.icc").write_bytes(icc_profile("sRGB", curve=table))


def _read_icc(path: Path):
    """Through a photo that holds it, which is read all the same if the profile is damaged."""
    photo = path.with_suffix(".jpg")
    try:
        Image.fromarray(pattern(8, 6)).save(photo, icc_profile=path.read_bytes())
    except (ValueError, OSError):  # A profile that no JPEG holds
        return None
    pixels = read_photo(photo).pixels
    with open_image(photo) as image:
        encoding = stated_encoding(image)
    return encoding.to_linear(pixels) if encoding is not None else None


def _video(folder: Path) -> None:
    frames = list(pan(12, 48, 64, 4))  # x265 damages memory below 50 pixels.
    for name in ("a.mp4", "a.mkv", "a.avi", "a.mts"):
        write_clip(folder / name, frames, codec="libx264", pixels="yuv420p")
    write_clip(folder / "hlg.mov", frames, tags=(18, 9, 9), pixels="yuv420p10le", rotation=90)
    write_clip(folder / "lossless.mkv", frames, codec="ffv1")


def _read_video(path: Path):
    clip = open_clip(path)
    chosen = choose_frames(clip)
    return [codes(frame, clip.color) for _, frame in decode(clip, set(chosen.numbers[:2]))]


def _sog(folder: Path) -> None:
    _splats(".sog")(folder)
    with zipfile.ZipFile(folder / "a.sog") as archive:
        archive.extractall(folder / "parts")


def _read_sog(folder: Path):
    """The file, and one of its parts whose checksums fit."""
    with zipfile.ZipFile(folder / "b.sog", "w") as archive:
        for part in sorted((folder / "parts").iterdir()):
            archive.write(part, part.name)
    problem = None
    for name in ("a.sog", "b.sog"):
        try:
            read_gaussians(folder / name)
        except SehdrError as error:
            problem = problem or error
    if problem:
        raise problem


def _spz(folder: Path) -> None:
    _splats(".spz")(folder)
    (folder / "plain.spz").write_bytes(gzip.decompress((folder / "a.spz").read_bytes()))


def _ocio(folder: Path) -> None:
    rows = "".join(f"{r} {g} {b}\n" for b in (0, 1) for g in (0, 1) for r in (0, 1))
    (folder / "look.cube").write_text(f"LUT_3D_SIZE 2\n{rows}")
    (folder / "curve.spi1d").write_text("Version 1\nFrom 0 1\nLength 3\nComponents 1\n{\n0\n0.4\n1\n}\n")
    (folder / "own.ocio").write_text("""ocio_profile_version: 2
search_path: .
roles: {default: raw, scene_linear: raw, aces_interchange: raw, cie_xyz_d65_interchange: raw}
file_rules:
  - !<Rule> {name: Default, colorspace: default}
displays:
  D:
    - !<View> {name: V, colorspace: out}
colorspaces:
  - !<ColorSpace>
    name: raw
  - !<ColorSpace>
    name: out
    from_scene_reference: !<GroupTransform>
      children:
        - !<FileTransform> {src: look.cube, interpolation: linear}
        - !<FileTransform> {src: curve.spi1d}
        - !<MatrixTransform> {matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
        - !<ExponentTransform> {value: [2.2, 2.2, 2.2, 1]}
""")


def _read_ocio(folder: Path):
    return ocio_view(str(folder / "own.ocio"), "V")(np.full((2, 2, 3), 0.18, np.float32))


def _dng_opcodes(folder: Path) -> None:
    size, stored = (24, 32), np.full((24, 32), 9000, np.uint16)
    rows = struct.pack(">I", 24) + np.linspace(0.5, 1.5, 24).astype(">f4").tobytes()
    lists = {
        "map": {51009: opcodes(gain_map(np.full((3, 4), 1.5), size))},
        "row": {51009: opcodes((12, area(size) + rows), (8, area(size) + struct.pack(">I2d", 1, 0.05, 0.8)))},
        "bad": {51008: opcodes((5, struct.pack(">3I", 0, 1, 1) + struct.pack(">6I", 4, 6, 2, 3, 4, 5)))},
        "lens": {
            51022: opcodes((3, struct.pack(">7d", 1, 0, 0, 0, 0, 0.5, 0.5)),
                           (1, struct.pack(">I8d", 1, 0.9, 0, 0, 0, 0, 0, 0.5, 0.5)))
        },
    }  # fmt: skip
    for name, tags in lists.items():
        write_tagged_dng(folder / f"{name}.dng", stored, tags)
    write_tagged_dng(folder / "linear.dng", np.repeat(stored[..., None], 3, 2))
    write_tagged_dng(folder / "mosaic.dng", (mosaic(np.full((24, 32, 3), 0.3)) * 65535).astype(np.uint16))


def _summary(folder: Path) -> None:
    (folder / "summary.json").write_text(json.dumps({"format": FORMAT} | SUMMARY))


def _plan(folder: Path) -> None:
    (folder / "plan.json").write_text(json.dumps({"format": FORMAT} | PLAN))


def _metrics(folder: Path) -> None:
    lines = [{"iteration": n, "seconds": 0.5, "psnr_ldr": 20.0, "psnr_hdr": None} for n in range(3)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def _opensfm(folder: Path) -> None:
    (folder / "images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(pattern(16, 12)).save(folder / "images" / name)
    perspective = {"projection_type": "perspective", "width": 16, "height": 12, "focal": 0.8, "k1": 0.01, "k2": 0.0}
    shots = {
        name: {"camera": "c", "rotation": [0.1, 0.2, 0.3 * n], "translation": [0.5, 0.25, 2.0], "gps_dop": 5}
        for n, name in enumerate(("a.jpg", "b.jpg"))
    }
    points = {"1": {"coordinates": [1.0, 2.0, 3.0], "color": [255, 0, 0]}}
    model = {"cameras": {"c": perspective}, "shots": shots, "points": points}
    (folder / "reconstruction.json").write_text(json.dumps([model]))


def _chan(folder: Path) -> None:
    (folder / "own.chan").write_text("".join(f"{n} 0.5 1.5 {n}.0 10 20 30 45.5\n" for n in range(1, 5)))


_RUN_FILES = ("*.json", "metrics.jsonl")
READERS = {
    "colmap-binary": Reader(_colmap(True), ("sparse/0/*.bin",), read_colmap, cost=3),
    "colmap-text": Reader(_colmap(False), ("sparse/0/*.txt",), read_colmap, text=True, cost=3),
    "transforms": Reader(_transforms, ("transforms.json",), read_transforms, text=True, cost=1.2),
    "hdr-nerf": Reader(_hdr_nerf, ("*.json", "sparse/0/*"), read_hdr_nerf, text=True, cost=2),
    "exposures": Reader(_exposures, ("exposures.json",), _load, text=True, cost=5),
    "scene": Reader(_transforms, ("transforms.json", "images/*"), _load, text=True, cost=7),
    "llff": Reader(_llff, ("poses_bounds.npy",), read_llff),
    "llff-seconds": Reader(_llff_seconds, ("poses_bounds_exps.npy",), read_hdr_nerf_real),
    "ply-points": Reader(_points, ("*.ply",), each(read_ply_points), text=True, cost=0.5),
    "exr": Reader(_exr, ("*.exr",), each(hdr_size, read_hdr, read_exr_channels)),
    "radiance": Reader(_radiance, ("*.hdr",), each(read_hdr), cost=0.5),
    "photos": Reader(_photos, ("*",), each(photo_sizes, read_mask, exif_exposure, _read_photo), cost=1.2),
    "raw": Reader(_raw, ("*",), each(photo_sizes, raw_exposure, _read_matrix, _read_photo), cost=2),
    "config": Reader(_config, ("*.toml",), each(load_config), text=True, cost=0.6),
    "run": Reader(_run, _RUN_FILES, _read_run, text=True, repair=_resign, cost=5),
    "checkpoint": Reader(_run, ("checkpoints/*/*",), _read_run, text=True, repair=_resign, cost=4),
    "confidence": Reader(_confidence, ("confidence.safetensors",), _read_confidence, cost=5),
    "resume": Reader(_run, (*_RUN_FILES, "checkpoints/*/*"), _resume, text=True, repair=_resign, cost=20),
    "responses": Reader(_responses, ("*",), each(_read_response), text=True, cost=30),
    "curves": Reader(_curves, ("*",), each(_read_response), text=True),
    "cameras": Reader(_cameras, ("*.json",), each(load_cameras), text=True, cost=0.5),
    "cameras-of-others": Reader(_cameras_of_others, ("*.json",), each(load_cameras), text=True, cost=0.7),
    "ply": Reader(_splats(".ply"), ("*",), each(read_gaussians), text=True, cost=0.7),
    "glb": Reader(_splats(".glb"), ("*",), each(read_gaussians), text=True, repair=_rechunk, cost=0.5),
    "compressed-ply": Reader(_splats(".compressed.ply"), ("*",), each(read_gaussians), text=True, cost=1.4),
    "sog": Reader(_sog, ("*.sog", "parts/*"), _read_sog, text=True, cost=7),
    "spz": Reader(_spz, ("*",), each(read_gaussians), cost=1.1),
    "gain-maps": Reader(_gain_maps, ("*",), each(_read_light), cost=1.6),
    "heic": Reader(_heic, ("*",), each(photo_sizes, exif_exposure, _read_photo), cost=0.9),
    "icc": Reader(_icc, ("*.icc",), each(_read_icc), cost=4),
    "video": Reader(_video, ("*",), each(_read_video), cost=150),
    "dng-opcodes": Reader(_dng_opcodes, ("*",), each(photo_sizes, raw_exposure, _read_photo), cost=6),
    "summary": Reader(_summary, ("*",), lambda folder: RunFolder(folder).read_summary(), text=True, cost=0.6),
    "plan": Reader(_plan, ("*",), lambda folder: RunFolder(folder).read_decisions(), text=True, cost=0.5),
    "metrics": Reader(_metrics, ("*",), lambda folder: RunFolder(folder).read_metrics(), text=True, cost=0.5),
    "ocio": Reader(_ocio, ("*",), _read_ocio, text=True, cost=1.3),
    "opensfm": Reader(_opensfm, ("reconstruction.json",), read_opensfm, text=True, cost=0.9),
    "chan": Reader(_chan, ("*",), each(load_cameras), text=True, cost=1.4),
    "usd": Reader(_splats(*USD_SUFFIXES), ("*",), each(_read_usd), text=True, cost=20),
}


class Workspace:
    """A reader's files in a folder of their own, of which one at a time is changed."""

    def __init__(self, reader: Reader, folder: Path):
        self.reader, self.folder = reader, folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        reader.make(folder)
        self.whole = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
        targets = sorted({path for glob in reader.files for path in folder.glob(glob) if path.is_file()})
        self.targets = {path: self.whole[path] for path in targets}
        self.changed = targets[0]
        self.times = {path: path.stat().st_mtime_ns for path in self.whole}

    def read(self) -> object:
        return self.reader.read(self.changed if hasattr(self.reader.read, "alone") else self.folder)

    def restore(self) -> None:
        found = [Path(place, name) for place, _, names in os.walk(self.folder) for name in names]
        for path in {*found} - self.whole.keys():
            path.unlink()
        for path, data in self.whole.items():
            if path == self.changed or not path.is_file() or path.stat().st_mtime_ns != self.times[path]:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
                self.times[path] = path.stat().st_mtime_ns
