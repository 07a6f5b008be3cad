"""Stray light, stripes and defects as augmentations: the library's own functions with the numbers that were drawn."""

from __future__ import annotations

import kornia.augmentation as K
import pytest
import torch
from drawing import agree_row_by_row, augmented, in_light, picture, wavelengths_for
from torch import Tensor

import kcam.augmentation as KC
from kcam import optics, sensor
from kcam.units import mm, nm, um


@pytest.mark.parametrize("channels", [1, 3, 28])
def test_glare_is_veiling_glare_at_each_channel_s_wavelength(channels: int) -> None:
    augmentation = KC.RandomVeilingGlare(share=(0.1, 0.3), focal_length=6 * mm, pixel_pitch=10 * um, p=1.0)

    def by_hand(light: Tensor, row: int, drawn: dict[str, Tensor]) -> Tensor:
        grid = wavelengths_for(channels)
        share, core, slope = (float(drawn[name][row]) for name in ("share", "core", "slope"))
        planes = []
        for index, wavelength in enumerate(grid.tolist()):
            own = 1 - (1 - share) ** ((550 * nm / wavelength) ** 2)
            core_here = core * 600 * wavelength / (550 * nm)
            one = light[:, index : index + 1]
            planes.append(optics.veiling_glare(one, share=own, core=core_here, slope=slope, reach=600.0))
        return torch.cat(planes, 1)

    agree_row_by_row(augmentation, picture(3, channels, 17, 12), by_hand, bound=1e-6)


def test_glare_takes_contrast_and_leaves_the_mean() -> None:
    light = in_light(picture(2, 3, 24, 24))
    augmentation = KC.RandomVeilingGlare(share=0.2, p=1.0)
    _, drawn = augmented(augmentation, light)
    hazy = augmentation.simulate(light, drawn)
    torch.testing.assert_close(hazy.mean((-2, -1)), light.mean((-2, -1)))
    contrast = hazy.std((-2, -1)) / light.std((-2, -1))
    assert (contrast < 0.86).all()
    assert (contrast[:, 2] < contrast[:, 0]).all()  # blue most


def test_banding_is_stripes_of_the_frame_and_of_the_sensor() -> None:
    augmentation = KC.RandomBanding((5.0, 20.0), (30.0, 60.0), full_well=2000.0, p=1.0)

    def by_hand(light: Tensor, row: int, drawn: dict[str, Tensor]) -> Tensor:
        own = {"full_well": 2000.0, "row": 0.0, "column": 0.0}
        seed = int(drawn["sensor_seed"][row])
        fixed = sensor.fixed_stripes(light, seed=seed, **own | {"column": float(drawn["column"][row])})
        generator = torch.Generator().manual_seed(int(drawn["noise_seed"][row]))
        return sensor.row_column_noise(fixed, generator=generator, **own | {"row": float(drawn["row"][row])})

    agree_row_by_row(augmentation, 0.5 + 0.4 * picture(3, 3, 9, 11), by_hand, bound=1e-6)


def test_hot_pixels_are_defects_of_one_sensor_up_to_its_well() -> None:
    augmentation = KC.RandomHotPixels((0.05, 0.2), (0.05, 0.1), (500.0, 5000.0), full_well=4000.0, p=1.0)

    def by_hand(light: Tensor, row: int, drawn: dict[str, Tensor]) -> Tensor:
        shares = {name: float(drawn[name][row]) for name in ("hot", "dead", "electrons")}
        seed = int(drawn["sensor_seed"][row])
        return sensor.defect_pixels(light, full_well=4000.0, seed=seed, **shares).clamp(max=1)

    agree_row_by_row(augmentation, picture(4, 3, 12, 13), by_hand, bound=1e-6)


def test_the_frames_of_a_clip_share_their_sensor() -> None:
    frame = torch.full((1, 3, 24, 24), 0.5)
    clip = frame[:, None].expand(1, 4, 3, 24, 24).contiguous()
    defects = K.VideoSequential(KC.RandomHotPixels(hot=0.1, p=1.0), data_format="BTCHW", same_on_frame=True)(clip)
    assert all(torch.equal(defects[:, 0], defects[:, k]) for k in range(1, 4))
    banding = K.VideoSequential(
        KC.RandomBanding(row=30.0, column=30.0, p=1.0), data_format="BTCHW", same_on_frame=True
    )(clip)
    light = ((banding + 0.055) / 1.055) ** 2.4
    columns, rows = light.mean(-2, keepdim=True), light.mean(-1, keepdim=True)
    assert not torch.allclose(rows[:, 0], rows[:, 1], atol=1e-3)
    shift = columns[:, 0] - columns[:, 1]  # only by the mean of the rows
    assert float(shift.std(-1).max()) < 1e-5


@pytest.mark.parametrize(
    ("build", "error", "text"),
    [
        (lambda: KC.RandomVeilingGlare(share=(0.0, 2.0)), ValueError, "share must be .* <= 0.9"),
        (lambda: KC.RandomVeilingGlare(core=0.0), ValueError, r"core must be .*\[rad\] with 1e-06 <= low"),
        (lambda: KC.RandomVeilingGlare(slope=(0.0, 2.0)), ValueError, "slope must be .* with 0.1 <= low"),
        (lambda: KC.RandomVeilingGlare(focal_length=50.0), ValueError, r"focal_length 50 .* did you mean 50 \* mm\?"),
        (lambda: KC.RandomVeilingGlare(pixel_pitch=4.0), ValueError, r"pixel_pitch 4 .* did you mean 4 \* um\?"),
        (lambda: KC.RandomBanding(row=-1.0), ValueError, r"row must be .*\[electrons\]"),
        (lambda: KC.RandomBanding(full_well=0.0), ValueError, "full_well"),
        (lambda: KC.RandomHotPixels(hot=(0.0, 0.1)), ValueError, "hot must be .* with 1e-09 <= low"),
        (lambda: KC.RandomHotPixels(hot=0.7, dead=0.7), ValueError, "up to 1.4 of the pixels together, more than all"),
        (lambda: KC.RandomHotPixels(electrons=-1.0), ValueError, r"electrons must be .*\[electrons\]"),
        (lambda: KC.RandomHotPixels(full_well=-1.0), ValueError, "full_well"),
    ],
)
def test_errors(build, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        build()
