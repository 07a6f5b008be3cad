"""What `kcam shoot` does: photographs of photographs, one file at a time, in bounded memory."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from kcam import files, optics, plots, sensor
from kcam.camera import Camera
from kcam.data.photos import PICTURES, files_in
from kcam.planner import Plan
from kcam.planner import shoot as within
from kcam.scene import Scene


def outputs(photos: Sequence[Path], out: Path) -> list[tuple[Path, Path]]:
    """Which file each photo becomes: `out` itself for one, else a .png of the same name in the folder `out`.

    Raises:    FileNotFoundError, ValueError for a photo that is not there, a folder without pictures, two photos of one
               name, or a name that cannot be written, before anything is taken.
    """
    found: list[Path] = []
    for photo in photos:
        inside = files_in(photo, below=False) if photo.is_dir() else [photo]
        if not inside:
            raise ValueError(f"there is no picture in the folder {photo}: expected {', '.join(PICTURES)}.")
        found += inside
    single = len(found) == 1 and not photos[0].is_dir() and not out.is_dir() and out.suffix != ""
    if single:
        plots.check_writable(out)
        pairs = [(found[0], out)]
    else:
        if out.suffix.lower() in plots.PICTURE_SUFFIXES and not out.is_dir():
            raise ValueError(f"{len(found)} photos do not fit into the one file {out}. Name a folder: --out shots/.")
        if out.exists() and not out.is_dir():
            raise ValueError(f"{out} is a file, and {len(found)} photos need a folder. Use --out shots/.")
        if not out.absolute().parent.is_dir():
            raise FileNotFoundError(f"there is no folder {out.parent} to make {out.name} in.")
        pairs = [(photo, out / f"{photo.stem}.png") for photo in found]
        name, times = Counter(target.name for _, target in pairs).most_common(1)[0]
        if times > 1:
            raise ValueError(f"two of the photos would both become {name}. Take them into different folders.")
        for _, target in pairs if out.is_dir() else ():
            plots.check_writable(target)
    for photo, target in pairs:
        if not photo.is_file():
            raise FileNotFoundError(f"there is no file {photo}. Expected a picture: PNG, JPEG, TIFF, WebP, ...")
        files.check_other(target, photo)
    return pairs


def shoot(
    camera: Camera,
    photo: Path,
    target: Path,
    *,
    distance: float,
    seed: int = 0,
    size: int | None = None,
    tolerance: float | str = 0.01,
) -> Plan:
    """Photograph a photograph at a distance, and write the picture; the same seed gives the same bytes.

    Args:      size: of the longer side [pixels], to which a larger photo is shrunk first; None: as it is.
               tolerance: of the raw, see `kcam.planner.shoot`; 0 for the reference physics.
    Returns:   what was simulated of it.
    Raises:    ValueError for a distance that is too near, a size above the photo's, or a camera that gives no picture.
    """
    scene = replace(Scene.from_file(photo), depth=distance)  # a length with its unit, or in metres as the help says
    longest = max(scene.shape[1:])
    if size is not None and size > longest:
        raise ValueError(f"{photo.name} has {longest} pixels on its longer side, and --size asks for {size}.")
    if size is not None:
        scene = scene.resized(size)
    for stage in camera:
        if isinstance(stage, optics.Imaging):
            check_not_too_near(stage, distance, shape=(scene.shape[1], scene.shape[2]))
    with torch.no_grad():
        picture, plan = within(camera, scene, tolerance=tolerance, generator=torch.Generator().manual_seed(seed))
    grey = picture.shape[1] == 1 and not any(isinstance(stage, sensor.Mosaic) for stage in camera)
    if picture.shape[1] != 3 and not grey:
        raise ValueError(f"the camera gives {picture.shape[1]} channels, not a picture. Let it demosaic.")
    target.parent.mkdir(exist_ok=True)
    plots.write_picture(picture[0].clamp(0, 1), target)
    return plan


def check_not_too_near(imaging: optics.Imaging, distance: float, *, shape: tuple[int, int]) -> None:
    """ValueError for a distance at which a point's blur is wider than the picture: its light would be lost.

    The blur is the shadow of the aperture, D d (1 / z - 1 / z_focus) wide; inside the focal length no image is real.
    """
    lens = imaging.lens
    if not isinstance(lens, optics.Lens):  # of measured PSFs no aperture is known, nor need there be one
        return
    width = 2 * float(lens.aperture.semi_aperture().detach())
    per_vergence = width * float(lens.sensor_distance) / imaging.pixel_pitch  # pixels per 1/m
    side = min(*shape, *(imaging.accuracy.psf_shape or ()))
    focus = 1 / lens.focus_distance
    focal_length = float(lens.focal_length())
    nearest = max(1 / (focus + side / per_vergence), focal_length)
    if distance <= nearest:
        blur = per_vergence * (1 / distance - focus)
        reason = f"a point there blurs over {blur:.0f} pixels, of which there are {side}"
        if distance <= focal_length:
            reason = f"it is inside the focal length of {focal_length * 1e3:.3g} mm, where nothing has an image"
        raise ValueError(
            f'distance {distance:g} m is too near: {reason}. Use --distance "{math.ceil(nearest * 101)} cm" or more.'
        )
