"""A bare folder of photos: cameras, poses and points by structure from motion."""

from pathlib import Path

from ..errors import InputError
from .capture import Capture, Shot
from .images import HDR_SUFFIXES, LDR_SUFFIXES, image_sizes
from .names import list_images
from .sfm import reconstruct


def read_photos(folder: Path, cache: Path | str | None = None) -> Capture:
    """One shot for each photo of the folder, or of its `images/`, that structure from motion could place."""
    places = (place for place in (folder, folder / "images") if place.is_dir())
    photos = next((found for place in places if (found := list_images(place, LDR_SUFFIXES))), [])
    if not photos:
        kinds = sorted({file.suffix.lower() for file in folder.iterdir() if file.suffix.lower() in HDR_SUFFIXES})
        found = f"only {', '.join(kinds)} files" if kinds else "no photos and no known layout"
        raise InputError(folder, f"has {found}", "give photos (PNG, JPEG, TIFF), a COLMAP set or a transforms.json")
    if len(photos) < 2:
        raise InputError(photos[0], "is the only photo; one view does not show depth", "add photos from other places")
    for photo in photos:
        image_sizes(photo)
    model, masks, shots, lost = reconstruct(photos, cache), folder / "masks", [], []
    placed = {int(Path(image.name).stem): image for image in model.images}
    for i, photo in enumerate(photos):
        if (image := placed.get(i)) is None:
            lost.append(photo.name)
            continue
        mask = next(
            (masks / f"{name}.png" for name in (photo.name, photo.stem) if (masks / f"{name}.png").is_file()), None
        )
        lens = model.cameras[image.camera_id]
        shots.append(Shot(photo.stem, photo, lens, image.world_to_camera, oriented=True, mask=mask))
    notes = ()
    if lost:
        notes = (f"{len(lost)} of {len(photos)} photos could not be placed and were left out: {', '.join(lost[:5])}",)
    return Capture("photos", tuple(shots), points=model.points, point_colors=model.colors, notes=notes)
