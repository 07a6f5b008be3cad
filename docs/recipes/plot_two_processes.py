"""
Two processes, one training
===========================

``torchrun`` starts one process for each GPU, or here two on the CPU, and they average their gradients. Two processes
with a picture each take the same steps as one process with both.
"""

# %%
# The script
# ----------
#
# ``train.py`` runs alone or under ``torchrun``, which tells each process its number in the environment. Process k of n
# takes the pictures k, k + n, ... of the batch. Two things make the result the same however many there are:
#
# - **Noise** has a seed for each picture and step, not for each process.
# - **The loss** is a mean over the pictures, and every process has as many, so that the mean of the processes'
#   gradients is the gradient of the mean.
#
# The script trains the diffractive element (DOE) of a small camera to bring pictures into focus that are too near.

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

TRAIN = '''
import json
import os
import sys

import torch
import torch.distributed.nn.functional  # first: imported later, as Adam does, its defaults hold the group for ever
from torch import distributed

from kcam import Camera, Scene, isp, optics, sensor
from kcam.units import mm, nm, um, wavelength_grid


def build():
    """A small camera whose DOE trains; the same numbers in each process."""
    phase = torch.nn.Parameter(0.1 * torch.randn(32, 32, generator=torch.Generator().manual_seed(0)))
    doe = optics.DOE(phase, design_wavelength=550 * nm)
    lens = optics.Lens(optics.CircularAperture(2 * mm), optics.ThinLens(16 * mm), doe, focus_distance=1.5)
    return Camera(
        optics.Imaging(lens, pixel_pitch=4 * um, psf_shape=(33, 33)), sensor.ColourFilter.kodak(),
        sensor.Mosaic("RGGB"), sensor.Exposure(), sensor.ShotNoise(full_well=10_000), sensor.ReadNoise(3.0),
        isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )


def main(path, steps=6):
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    torch.set_num_threads(1)
    camera = build()
    if world > 1:
        distributed.init_process_group("gloo")  # "nccl" on GPUs
    names = ("astronaut", "chelsea")
    scenes = [Scene.builtin(name, size=(64, 64), wavelengths=wavelength_grid(count=12)) for name in names]
    scenes = [scene.with_depth(0.8) for scene in scenes]
    optimiser = torch.optim.Adam(camera.parameters(), lr=0.2)
    losses = []
    for step in range(steps):
        own = range(rank, len(scenes), world)
        loss = 0
        for index in own:
            noise = torch.Generator().manual_seed(step * len(scenes) + index)
            picture = camera(scenes[index], generator=noise)
            loss = loss + (picture - scenes[index].to_srgb()).square().mean() / len(own)
        optimiser.zero_grad()
        loss.backward()
        mean = loss.detach().clone()
        if world > 1:
            for value in (mean, *(parameter.grad for parameter in camera.parameters())):
                distributed.all_reduce(value)  # a sum
                value /= world
        optimiser.step()
        losses.append(float(mean))
    if rank == 0:  # one process writes
        with open(path, "w") as file:
            json.dump({"processes": world, "losses": losses}, file)
    if world > 1:
        distributed.destroy_process_group()


if __name__ == "__main__":
    main(sys.argv[1])
'''

# %%
# One process, then two
# ---------------------
#
# In the shell it is ``python train.py one.json`` and ``torchrun --nproc-per-node=2 train.py two.json``. Here the same
# is started from Python: ``torchrun`` is the module ``torch.distributed.run``.


def run(*arguments):
    """Run Python in a process of its own; what it writes is shown if it fails."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # two processes on two cores
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


with tempfile.TemporaryDirectory() as folder:
    script, one, two = (str(Path(folder) / name) for name in ("train.py", "one.json", "two.json"))
    Path(script).write_text(TRAIN)
    run(script, one)
    run("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", script, two)
    alone, together = (json.loads(Path(path).read_text()) for path in (one, two))

print(f"{'step':>4s}{'one process':>14s}{'two processes':>16s}")
for step, (a, b) in enumerate(zip(alone["losses"], together["losses"], strict=True)):
    print(f"{step:4d}{a:14.6f}{b:16.6f}")
assert (alone["processes"], together["processes"]) == (1, 2)
assert abs(together["losses"][0] / alone["losses"][0] - 1) < 1e-5
assert all(abs(b / a - 1) < 0.1 for a, b in zip(alone["losses"], together["losses"], strict=True))
assert together["losses"][-1] < together["losses"][0]

figure, ax = plt.subplots(figsize=(9, 3.4), layout="constrained")
ax.plot(alone["losses"], "o-", label="one process, both pictures")
ax.plot(together["losses"], "x--", label="two processes, one picture each")
ax.set(title="The loss at each step", xlabel="step", ylabel="mean square error", ylim=(0, None))
ax.legend(frameon=False)

# %%
# ``torch.nn.parallel.DistributedDataParallel(camera)`` averages the gradients too, while the backward pass still runs,
# which pays on GPUs. On a CPU mind the threads of ``gloo``: ``destroy_process_group`` ends them only when nothing else
# holds the group. One that still lets go of a tensor while Python ends aborts the process ("terminate called without an
# active exception", torch 2.13), one run in ten of this script before its third import stood there.
#
# The first loss is the same to rounding. After that rounding may grow: a sum in another order differs in its last bit,
# and then somewhere a photon more or less is counted, which is a step and no rounding.
#
# How ``kcam train`` does it
# --------------------------
#
# .. code-block:: sh
#
#    torchrun --nproc-per-node=2 -m kcam train watercolour --out painter.safetensors
#
# ends in the same camera as one process, bit for bit on the same machine, torch and number of threads. It does without
# ``DistributedDataParallel``: what precedes the first noise is computed in each process for the whole batch; from there
# on each picture is developed, compared and differentiated by itself, by one of the processes, and what belongs to all
# of them is summed in their order, whoever had them. The batch must divide by the number of processes, and a run that
# was killed goes on with ``--resume``.
