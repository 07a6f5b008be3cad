"""
One cup in four lights
======================

Coffee in daylight, in the light of a bulb, of a fluorescent tube and of an LED. Above the camera is balanced for
daylight and shows the colour of each light; below it is balanced for the light at hand, and the cup looks nearly alike.
"""

# %%
# Nearly, for a camera sees three numbers: what a line spectrum leaves out no balance brings back.

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, isp, plots, sensor, spectral
from kcam.units import nm

lights = {"daylight, D65": "D65", "bulb, A": "A", "tube, FL2": "FL2", "LED, LED-B1": "LED-B1"}
wavelengths = torch.linspace(400, 720, 65) * nm
exposed = Camera(sensor.ColourFilter.nikon(), sensor.Exposure(0.6))
daylight = exposed.resolve(Scene.builtin("coffee", wavelengths=wavelengths))  # what stages know of filter and light
for_daylight = isp.WhiteBalance(isp.as_shot_gains(daylight)), isp.ColourMatrix(isp.as_shot_colour_matrix(daylight))
as_shot = isp.WhiteBalance(), isp.ColourMatrix()

fig, axes = plt.subplots(3, 4, figsize=(9, 5.6), layout="constrained", height_ratios=[1.2, 2, 2])
for column, (name, light) in zip(axes.T, lights.items(), strict=True):
    scene = Scene.builtin("coffee", size=220, wavelengths=wavelengths, illuminant=light)
    column[0].fill_between(wavelengths / nm, spectral.illuminant(light, wavelengths=wavelengths), color="0.6")
    column[0].set(title=name, yticks=[], xlabel="wavelength [nm]")
    for ax, balance in zip(column[1:], (for_daylight, as_shot), strict=True):
        camera = Camera(*exposed, *balance, isp.ToneCurve())
        ax.imshow(plots.as_image(camera(scene)[0]))
        ax.axis("off")
fig.suptitle("Four lights: spectrum, picture balanced for daylight, picture balanced for the light")
plt.show()
