"""A bare folder of photos: cameras, poses and points by structure from motion."""

from pathlib import Path

from ..errors import InputError
from .capture import Capture, Shot
from .images import HDR_SUFFIXES, LDR_SUFFIXES, image_sizes
from .names import list_images
from .sfm import reconstruct


def photo_folder(folder: Path) -> Path | None:
    """The folder itself or its `images/`, whichever holds photos."""
    for place in (folder, folder / "images"):
        if place.is_dir() and list_images(place, LDR_SUFFIXES):
            return place
    return None


def read_photos(folder: Path, cache: Path | str | None = None) -> Capture:
    """One shot for each photo that structure from motion could place, in the natural order of the names."""
    place = photo_folder(folder)
    if place is None:
        kinds = sorted({file.suffix.lower() for file in folder.iterdir() if file.suffix.lower() in HDR_SUFFIXES})
        found = f"only {', '.join(kinds)} files" if kinds else "no photos and no known layout"
        raise InputError(folder, f"has {found}", "give photos (PNG, JPEG, TIFF), a COLMAP set or a transforms.json")
    photos = list_images(place, LDR_SUFFIXES)
    if len(photos) < 2:
        raise InputError(photos[0], "is the only photo; one view does not show depth", "add photos from other places")
    for photo in photos:
        image_sizes(photo)
    model = reconstruct(photos, cache)
    placed = {int(Path(image.name).stem): image for image in model.images}
    shots = [
        Shot(photo.stem, photo, model.cameras[placed[i].camera_id], placed[i].world_to_camera, oriented=True,
             mask=_mask(folder, photo))
        for i, photo in enumerate(photos)
        if i in placed
    ]  # fmt: skip
    lost = [photo.name for i, photo in enumerate(photos) if i not in placed]
    notes = ()
    if lost:
        notes = (f"{len(lost)} of {len(photos)} photos could not be placed and were left out: {', '.join(lost[:5])}",)
    return Capture("photos", tuple(shots), points=model.points, point_colors=model.colors, notes=notes)


def _mask(folder: Path, photo: Path) -> Path | None:
    names = (f"{photo.name}.png", f"{photo.stem}.png")
    return next((folder / "masks" / name for name in names if (folder / "masks" / name).is_file()), None)
