"""What is kept is never stale: ways to change a lens, a stage or a camera, each against a camera that has kept nothing.

A way is a function of a camera, a lens and a random generator; it changes something between two pictures. Each runs
alone, and a walk strings random ones together, looking at pictures and gradients in random modes in between.
"""

from __future__ import annotations

import copy
import copyreg
import inspect
import io
import pickle
import pydoc
import random
import sys
import threading
import types
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn.utils import parametrize

from kcam import Camera, Context, Scene, optics, sensor
from kcam.cache import Settings, Unknown, ValueCache, seen, unchanged, value_of
from kcam.optics import accuracy as accuracy_module
from kcam.optics.propagation.table import choose
from kcam.optics.propagation.textbook import textbook_row
from kcam.optics.rendering.renderer import Renderer
from kcam.units import mm, um

# torch itself uses what it deprecates, when it first meets a tangent
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")

DOUBLE = torch.float64
WAVELENGTHS = torch.tensor([450e-9, 550e-9, 650e-9], dtype=DOUBLE)
STRENGTH = {"global": 0.0}


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


# ---- lenses, and elements that hold all sorts of things ------------------------------------------------------------


class Setting:
    pure = True

    def __init__(self) -> None:
        self.strength = 0.0


class Prism(optics.Element):
    """An OPD that rises along x, by the sum of everything that an element can hold."""

    offset = 0.0
    offsets = [0.0]  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.amount = nn.Parameter(torch.tensor(0.3, dtype=DOUBLE))
        self.numbers, self.by_name, self.chosen = [0.1, [0.2]], {"a": {"b": 0.1}}, {1}
        self.array, self.plain, self.setting = np.array([0.1, 0.2]), torch.tensor([0.1, 0.2]), Setting()

    def strength(self) -> Tensor:
        held = self.numbers[0] + self.numbers[1][0] + self.by_name["a"]["b"] + max(self.chosen) + self.setting.strength
        return self.amount + held + float(self.array.sum()) + self.plain.sum() + self.offset + self.offsets[0]

    def terms(self, pupil: Any, wavelengths: Tensor) -> Any:
        return [(torch.ones_like(wavelengths), 0.4e-6 * self.strength() * pupil.x.expand_as(pupil.rho2))]


class PurePrism(Prism):
    """Promises what is true of it: all that it reads it holds."""

    pure = True
    offset = 0.0
    offsets = [0.0]  # noqa: RUF012


class Sloped(Prism):
    """Another class on the same Parameter."""

    def terms(self, pupil: Any, wavelengths: Tensor) -> Any:
        return [(torch.ones_like(wavelengths), -0.4e-6 * self.strength() * pupil.y.expand_as(pupil.rho2))]


def closing_over(box: list[float]) -> type[Prism]:
    class Closing(Prism):
        def strength(self) -> Tensor:
            return self.amount + box[0] + STRENGTH["global"]

    return Closing


BOX = [0.5]
Closing = closing_over(BOX)
Promising = type("Promising", (PurePrism,), {"pure": True, "offset": 0.0, "offsets": [0.0]})
LENSES: dict[str, Callable[[], list[optics.Element]]] = {
    "round": lambda: [optics.Defocus(nn.Parameter(torch.tensor(0.02, dtype=DOUBLE)))],
    "zernike": lambda: [optics.ZernikeDOE(nn.Parameter(uniform(6) - 0.5))],
    "pixels": lambda: [optics.DOE(nn.Parameter(3 * uniform(8, 8)))],
    "prism": lambda: [Prism()],
    "pure": lambda: [PurePrism()],
    "closing": lambda: [Closing()],
}


def camera_of(name: str) -> Camera:
    lens = optics.Lens(
        optics.CircularAperture(4e-3),
        optics.ThinLens(nn.Parameter(torch.tensor(0.05, dtype=DOUBLE))),
        *LENSES[name](),
        sensor_distance=0.0520,
    )
    imaging = optics.Imaging(lens, pixel_pitch=6e-6, psf_shape=(9, 9))
    return Camera(imaging, sensor.ColourFilter.kodak(), sensor.Exposure()).double()


def scene_of(seed: int = 0, *, bands: bool = False, depth: Any = 1.2) -> Scene:
    if bands:
        return Scene.from_bands(uniform(1, 3, 10, 10, seed=seed), wavelengths=WAVELENGTHS, depth=depth)
    return Scene.from_rgb(uniform(1, 10, 10, seed=seed), wavelengths=WAVELENGTHS, depth=depth)


def anew(camera: Camera) -> Camera:
    """The same values in a camera that has kept nothing."""
    stages = [stage.changed() if isinstance(stage, optics.Imaging) else stage for stage in camera]
    stages[0]._forward_hooks = camera[0]._forward_hooks
    return Camera(*stages, context=camera.context)


# ---- ways to change something --------------------------------------------------------------------------------------


def put(module: nn.Module, name: str, value: Any, *, buffer: bool = False) -> None:
    """Set an attribute, whatever held the name before."""
    delattr(module, name)
    if buffer:
        module.register_buffer(name, value)
    else:
        setattr(module, name, value)


def numbers(lens: optics.Lens) -> list[tuple[nn.Module, str]]:
    found = [(lens, "sensor_distance"), (lens.aperture, "diameter")]
    for element in lens.elements:
        if isinstance(element, optics.ThinLens) and not parametrize.is_parametrized(element):
            found.append((element, "focal_length"))
        if isinstance(element, optics.Defocus):
            found.append((element, "added_vergence"))
    return found


def number(module: nn.Module, name: str) -> float:
    return float(torch.as_tensor(getattr(module, name)).detach())


KINDS: dict[str, Callable[[float], Any]] = {
    "float": float,
    "np.float32": np.float32,
    "np.float64": np.float64,
    "array": np.array,
    "tensor": lambda x: torch.tensor(x, dtype=DOUBLE),
    "single": torch.tensor,
    "trained tensor": lambda x: torch.tensor(x, dtype=DOUBLE, requires_grad=True),
    "Parameter": lambda x: nn.Parameter(torch.tensor(x, dtype=DOUBLE)),
    "frozen Parameter": lambda x: nn.Parameter(torch.tensor(x, dtype=DOUBLE), requires_grad=False),
}


def attribute_of(kind: str) -> Callable[..., None]:
    def change(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
        module, name = numbers(lens)[rng.choice([0, 0, -1])]
        put(module, name, KINDS[kind](number(module, name) * rng.choice([0.97, 0.99, 1.01, 1.03])))

    return change


def buffer(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    module, name = numbers(lens)[rng.choice([0, 0, -1])]
    put(module, name, torch.tensor(number(module, name) * 1.02, dtype=DOUBLE), buffer=True)


def held(lens: optics.Lens) -> list[Tensor]:
    """All tensors of a lens, wherever they are held."""
    found = [*lens.parameters(), *lens.buffers()]
    for module in lens.modules():
        found += [value for value in vars(module).values() if isinstance(value, Tensor)]
    return found


def any_of(lens: optics.Lens, rng: random.Random) -> Tensor:
    return rng.choice(held(lens) or [torch.zeros(1)])


def in_place(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    with torch.no_grad():
        any_of(lens, rng).mul_(1.02)


def in_data(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    any_of(lens, rng).data.mul_(0.98)


def by_numpy(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    view = any_of(lens, rng).detach().numpy()  # shares the memory, and no version counter knows
    view *= 1.02


def other_data(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    tensor = any_of(lens, rng)
    tensor.data = tensor.data * 1.02


def loaded(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    lens.load_state_dict({name: value * 1.01 for name, value in lens.state_dict().items()})


def loaded_by_assignment(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    lens.load_state_dict({name: value * 0.99 for name, value in lens.state_dict().items()}, assign=True)


def stepped(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    trained = [p for p in lens.parameters() if p.requires_grad]
    if trained:
        optimiser = torch.optim.SGD(trained, lr=1e-6)
        camera(scene_of()).sum().backward()
        for parameter in trained:
            if parameter.grad is not None:  # a step of 1 %, whatever the slope
                parameter.grad.sign_().mul_(1e4 * parameter.detach().abs().mean())
        optimiser.step()
        optimiser.zero_grad()


def element_swapped(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    lens.elements[2] = LENSES[rng.choice(list(LENSES))]()[0].double()


def element_added(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    lens.elements.append(optics.Defocus(rng.choice([-0.05, 0.05])))


def element_removed(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    if len(lens.elements) > 3:
        del lens.elements[-1]


def other_class(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    """Another element on the same Parameter: all plain attributes and all tensors are as before."""
    element = lens.elements[2]
    if isinstance(element, optics.ZernikeDOE):
        lens.elements[2] = optics.RadialDOE(element.coefficients)
    elif isinstance(element, optics.RadialDOE):
        lens.elements[2] = optics.ZernikeDOE(element.profile)
    elif isinstance(element, Prism):
        element.__class__ = Prism if type(element) is Sloped else Sloped


def list_edited(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    for element in lens.elements:
        if isinstance(element, Prism):
            rng.choice([element.numbers, element.numbers[1]])[0] += 0.5


def mapping_edited(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    for element in lens.elements:
        if isinstance(element, Prism):
            element.by_name["a"]["b"] += 0.5


def set_edited(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    for element in lens.elements:
        if isinstance(element, Prism):
            element.chosen.symmetric_difference_update({2})


def array_edited(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    for element in lens.elements:
        if isinstance(element, Prism):
            element.array[rng.randrange(2)] += 0.5


def object_edited(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    for element in lens.elements:
        if isinstance(element, Prism):
            element.setting.strength += 0.5


def class_edited(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    if isinstance(lens.elements[2], Prism):
        cls = type(lens.elements[2])
        if rng.random() < 0.5:
            cls.offset = 0.5 - cls.offset
        else:
            cls.offsets[0] = 0.5 - cls.offsets[0]


def method_of_the_class(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    """Onto a class that the table makes for itself."""
    if isinstance(lens.elements[2], Prism):
        gain = rng.uniform(1.5, 2.5)
        new = type("Gained", (type(lens.elements[2]),), {"pure": True, "offset": 0.0, "offsets": [0.0]})
        new.strength = lambda self: gain * Prism.strength(self)
        lens.elements[2].__class__ = new


def closure_and_global(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    if rng.random() < 0.5:
        BOX[0] = 1.5 - BOX[0]
    else:
        STRENGTH["global"] = 1.0 - STRENGTH["global"]


def method_of_the_instance(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    add = rng.choice([0.02, 0.04])
    lens.elements[1].vergence = types.MethodType(
        lambda self, grid: optics.ThinLens.vergence(self, grid) + add, lens.elements[1]
    )


class Scaled(nn.Module):
    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, value: Tensor) -> Tensor:
        return value * self.factor


def parametrized(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    element = lens.elements[1]
    if parametrize.is_parametrized(element):
        element.parametrizations.focal_length[0].factor *= rng.choice([0.99, 1.01])
    elif "focal_length" in element._parameters:
        parametrize.register_parametrization(element, "focal_length", Scaled(1.01))


def gradients_toggled(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    for tensor in held(lens):
        if tensor.is_leaf and rng.random() < 0.5:
            tensor.requires_grad_(not tensor.requires_grad)


def mode_toggled(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    camera.train(not camera.training)


def rounded(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    lens.float()  # rounds what it holds


def hooked(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    factor = rng.uniform(0.5, 1.5)
    camera[0].register_forward_hook(lambda module, given, result: result * factor)


SETTINGS: dict[str, tuple[Any, ...]] = {
    "propagator": ("nonparaxial", "fresnel", textbook_row(128), textbook_row(160)),
    "pixel_pitch": (6e-6, 7e-6, np.float32(5e-6)),
    "fill_factor": (1.0, 0.4, np.float64(0.7)),
    "bands": (None, 1, 2),
    "border": ("reflect", "zero"),
    "integrate": (True, False),
    "psf_shape": ((9, 9), (7, 9), (5, 5)),
    "renormalise": (False, True),
    "kappa": (None, 1.6),
    "blur": (True, True, False),
    "direct": (False, True),
}


def stage_set(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    name = rng.choice(list(SETTINGS))
    setattr(camera[0], name, rng.choice(SETTINGS[name]))


def lens_replaced(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    camera[0].lens = copied_lens(lens)
    camera[0].lens.sensor_distance = 1.01 * number(lens, "sensor_distance")


def copied_lens(lens: optics.Lens) -> optics.Lens:
    apart = optics.Lens(*lens.elements, sensor_distance=0.05, focus_wavelength=lens.focus_wavelength)
    put(apart, "sensor_distance", number(lens, "sensor_distance"))
    return apart


def filter_edited(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    alpha = camera[1].coefficients
    alpha.data[rng.randrange(len(alpha))] *= 1.1


def filter_replaced(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    camera.stages[1] = rng.choice([sensor.ColourFilter.nikon, sensor.ColourFilter.kodak])().double()


def context_replaced(camera: Camera, lens: optics.Lens, rng: random.Random) -> None:
    camera.context = Context(white_share=rng.choice([0.6, 0.4]))


WAYS: dict[str, Callable[..., None]] = {f"attribute_{kind}": attribute_of(kind) for kind in KINDS} | {
    way.__name__: way
    for way in (
        buffer, in_place, in_data, by_numpy, other_data, loaded, loaded_by_assignment, stepped, element_swapped,
        element_added, element_removed, other_class, list_edited, mapping_edited, set_edited, array_edited,
        object_edited, class_edited, method_of_the_class, closure_and_global, method_of_the_instance, parametrized,
        gradients_toggled, mode_toggled, rounded, hooked, stage_set, lens_replaced, filter_edited, filter_replaced,
        context_replaced,
    )
}  # fmt: skip
HELD = {"list_edited", "mapping_edited", "set_edited", "array_edited", "object_edited", "class_edited"}


# ---- what is looked at ---------------------------------------------------------------------------------------------


def leaves(camera: Camera) -> list[Tensor]:
    found = {id(t): t for t in (*held(camera[0].lens), *camera.parameters()) if t.requires_grad and t.is_leaf}
    return list(found.values())


def with_gradients(camera: Camera, scene: Scene) -> list[Tensor]:
    light = scene.coefficients.clone().requires_grad_()
    picture = camera(replace(scene, coefficients=light))
    found = torch.autograd.grad(picture.square().sum(), [light, *leaves(camera)], allow_unused=True)
    return [picture.detach(), *(torch.zeros(()) if g is None else g for g in found)]


def plainly(camera: Camera, scene: Scene) -> list[Tensor]:
    with torch.no_grad():
        return [camera(scene)]


def without_graphs(camera: Camera, scene: Scene) -> list[Tensor]:
    picture = camera(scene)
    assert picture.requires_grad == bool(leaves(camera)), "a picture that trained parts made carries their graph"
    return [picture.detach()]


def inferred(camera: Camera, scene: Scene) -> list[Tensor]:
    with torch.inference_mode():
        return [camera(scene)]


def functional(camera: Camera, scene: Scene) -> list[Tensor]:
    """Other values for one call only, with their gradients."""
    values = {name: (1.01 * p).detach().requires_grad_() for name, p in camera.named_parameters()}
    picture = torch.func.functional_call(camera, values, (scene,))
    found = torch.autograd.grad(picture.square().sum(), list(values.values()), allow_unused=True)
    return [picture.detach(), *(g for g in found if g is not None)]


def replica_of(module: nn.Module, factor: float) -> Any:
    """As `nn.parallel.replicate` makes it on several GPUs: parameters become attributes that are no leaves."""
    replica = module._replicate_for_data_parallel()
    for name, value in module._parameters.items():
        setattr(replica, name, None if value is None else factor * value)
    for name, value in module._buffers.items():
        replica._buffers[name] = value
    for name, child in module._modules.items():
        replica._modules[name] = replica_of(child, factor)
    return replica


def replicated(camera: Camera, scene: Scene) -> list[Tensor]:
    picture = replica_of(camera, 0.99)(scene)
    if not picture.requires_grad:
        return [picture]
    found = torch.autograd.grad(picture.square().sum(), leaves(camera), allow_unused=True)
    return [picture.detach(), *(g for g in found if g is not None)]


def forwards(camera: Camera, scene: Scene) -> list[Tensor]:
    """The tangent to one of the numbers of the lens, where forward mode can compute it."""
    module, name = numbers(camera[0].lens)[0]
    before = getattr(module, name)
    try:
        with forward_ad.dual_level():
            value = torch.tensor(number(module, name), dtype=DOUBLE)
            put(module, name, forward_ad.make_dual(value, torch.ones_like(value)))
            parts = forward_ad.unpack_dual(camera(scene))
            return [parts.primal.detach(), torch.zeros(()) if parts.tangent is None else parts.tangent.detach()]
    except (NotImplementedError, RuntimeError):
        return []
    finally:
        put(module, name, before)


LOOKS = (*[with_gradients, without_graphs, inferred, functional, replicated] * 2, forwards)


def same(found: list[Tensor], expected: list[Tensor]) -> bool:
    return len(found) == len(expected) and all(
        a.shape == b.shape and float((a - b).abs().max()) <= 1e-9 * float(b.abs().max())
        for a, b in zip(found, expected, strict=True)
    )


def look(camera: Camera, scene: Scene, how: Callable[..., list[Tensor]]) -> None:
    """As a camera that has kept nothing, twice: what was kept before the change, and what is kept now."""
    expected = how(anew(camera), scene)
    for _ in range(2 if how is plainly else 1):
        assert same(how(camera, scene), expected), how.__name__


@pytest.fixture(autouse=True)
def put_back() -> Iterator[None]:
    yield
    BOX[0], STRENGTH["global"] = 0.5, 0.0
    for cls in (Prism, PurePrism, Closing, Sloped, Promising):
        cls.offset, cls.offsets = 0.0, [0.0]


def lens_for(name: str) -> str:
    """One that the way acts on."""
    if name in HELD:
        return "pure"
    return {"other_class": "zernike", "method_of_the_class": "pure", "closure_and_global": "closing"}.get(name, "round")


@pytest.mark.parametrize("name", WAYS)
def test_a_change_shows(name: str) -> None:
    """Each way alone; most change the picture, or this would test nothing."""
    camera, scene, rng = camera_of(lens_for(name)), scene_of(), random.Random(1)
    shown = []
    for _ in range(3):  # the second time the change may be all that tells
        before = plainly(camera, scene)
        assert same(plainly(camera, scene), before)
        WAYS[name](camera, camera[0].lens, rng)
        look(camera, scene, plainly)
        shown.append(not same(plainly(camera, scene), before))
    look(camera, scene, with_gradients)
    assert any(shown) or name in ("element_removed", "gradients_toggled", "mode_toggled")


@pytest.mark.parametrize("name", sorted(HELD))
@pytest.mark.parametrize("lens", ["prism", "closing"])
def test_elements_that_promise_nothing_are_computed_anew(name: str, lens: str) -> None:
    camera, scene = camera_of(lens), scene_of()
    plainly(camera, scene)
    WAYS[name](camera, camera[0].lens, random.Random(2))
    look(camera, scene, plainly)


def walk(seed: int, *, steps: int) -> None:
    rng = random.Random(seed)
    camera, scene = camera_of(rng.choice(list(LENSES))), scene_of()
    some = rng.sample(list(WAYS), 4)  # again and again: the second time the change may be all that tells
    for _ in range(steps):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            WAYS[rng.choice(some)](camera, camera[0].lens, rng)
        if rng.random() < 0.2:
            scene = scene_of(rng.randrange(9), bands=rng.random() < 0.5, depth=rng.choice([0.9, 1.2, float("inf")]))
        if rng.random() < 0.1:
            scene = scene.to(dtype=rng.choice([torch.float32, DOUBLE]))
        for how in (plainly, rng.choice(LOOKS)):
            look(camera, scene, how)


@pytest.mark.parametrize("seed", [100, 110])
def test_random_changes(seed: int) -> None:
    walk(seed, steps=10)


@pytest.mark.slow  # 80 s
@pytest.mark.parametrize("seed", range(100, 200))
def test_many_random_changes(seed: int) -> None:
    walk(seed, steps=10)


# ---- what is kept, and what a value is -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", LENSES)
def test_what_promises_is_kept_and_nothing_else(name: str, monkeypatch) -> None:
    """A second picture of the same lens computes no PSF, unless an element has promised nothing."""
    camera, calls = camera_of(name), []
    monkeypatch.setattr(accuracy_module, "choose", lambda *args, **named: calls.append(1) or choose(*args, **named))
    plainly(camera, scene_of())
    assert calls
    calls.clear()
    plainly(camera, scene_of(seed=1))
    assert bool(calls) == (name in ("prism", "closing"))


@pytest.mark.parametrize("stage", [{}, {"propagator": textbook_row(128)}], ids=["row by name", "kcam's own row"])
def test_own_propagators_are_kept(stage: dict[str, Any]) -> None:
    assert value_of(camera_of("round")[0].changed(**stage), []) == value_of(camera_of("round")[0].changed(**stage), [])


def values() -> list[Any]:
    """No two alike; each call makes new objects."""
    tensor = torch.tensor([1.0, 2.0])
    return [
        None, True, 1, 1.0, 1 + 0j, "1", b"1", 0.0, -0.0, float("nan"), float("inf"),
        np.float32(1), np.float64(1), np.int64(1), np.bool_(True), np.array(1.0), np.array([1.0]), np.array([[1.0]]),
        np.array([1.0], dtype=np.float32), np.array(["a"]), np.array(["b"]), np.array([-0.0]), np.array([0.0]),
        torch.float32, torch.float64, torch.device("cpu"),
        tensor, tensor.double(), tensor[None], tensor.clone().requires_grad_(), nn.Parameter(tensor),
        nn.Parameter(tensor, requires_grad=False), torch.tensor([1.0, 3.0]), torch.tensor([-0.0, 1.0]),
        torch.tensor([0.0, 1.0]), torch.tensor([1.0, float("nan")]), torch.tensor([1 + 1j]), torch.tensor([1 - 1j]),
        torch.tensor([True]), torch.tensor([1]), torch.tensor([1], dtype=torch.int16), torch.tensor([1.0]).bfloat16(),
        (), [], {}, set(), (1,), [1], (1.0,), ((1,),), [1, 2], [2, 1], {1}, frozenset({1}), {1: 2}, {2: 1},
        {1: 2, 3: 4}, {3: 4, 1: 2}, OrderedDict({1: 2}), {"a": [1]}, {"a": [2]}, {"a": tensor},
        optics.Defocus(0.1), optics.Defocus(0.2), optics.Defocus(torch.tensor(0.1)), optics.CircularAperture(0.1),
        nn.ModuleList([optics.Defocus(0.1)]), PurePrism(), nn.Linear(2, 2, bias=False).requires_grad_(False),
    ]  # fmt: skip


def snapshot(thing: Any) -> tuple[Any, list[bytes]]:
    tensors: list[Tensor] = []
    plain = value_of(thing, tensors)
    return plain, tensors


def kept_as(thing: Any, other: Any) -> bool:
    """Whether a cache takes the other for the one."""
    cache = ValueCache()
    with torch.no_grad():
        first = cache.get(thing, lambda: torch.zeros(1))
        return cache.get(other, lambda: torch.zeros(1)) is first


def test_values_are_told_apart() -> None:
    torch.manual_seed(0)
    ones = values()
    others = copy.deepcopy(ones)
    for i, one in enumerate(ones):
        for j, other in enumerate(others):
            assert kept_as(one, other) == (i == j), (one, other)


def cell() -> list[Any]:
    ring: list[Any] = [1]
    ring.append(ring)
    return ring


@pytest.mark.parametrize(
    "thing",
    [
        lambda: 1, np.sin, len, type("C", (), {})(), optics.CircularAperture, iter([]), torch.Generator(), io.BytesIO(),
        np.array([None]), np.ma.masked_array([1.0]), torch.eye(2).to_sparse(), torch.empty(2, device="meta"),
        type("F", (float,), {})(1.0), type("L", (list,), {})([1]), {(1, 2)}, {1.0}, Prism(), Scaled(1.0), cell(), sys,
        type("T", (Tensor,), {})(), type("D", (optics.Defocus,), {})(0.1),
        type("P", (PurePrism, list), {"pure": True})(), type("S", (PurePrism,), {"pure": True, "__slots__": ("x",)})(),
    ],
    ids=lambda thing: type(thing).__name__,
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:Sparse")
def test_what_cannot_be_known_is_computed_again(thing: Any) -> None:
    for one in (thing, [thing], {"a": thing}):
        with pytest.raises(Unknown):
            value_of(one, [])
        assert not kept_as(one, one)


def test_hooks_and_methods_on_an_instance_cannot_be_known() -> None:
    hooked, patched = optics.Defocus(0.1), optics.Defocus(0.1)
    hooked.register_forward_hook(lambda *_: None)
    patched.vergence = lambda wavelengths: wavelengths
    for element in (hooked, patched):
        with pytest.raises(Unknown):
            value_of(element, [])


def test_methods_are_told_apart_by_their_code_defaults_and_closures_and_by_the_class(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    held = [0.0]

    class Changing(PurePrism):
        pure = True
        offset, offsets = 0.0, [0.0]

        def __init__(self) -> None:
            super().__init__()

        def more(self, amount: list[float] = [0.0]) -> float:  # noqa: B006
            return amount[0] + held[0]

        @property
        def rest(self) -> float:
            return 0.0

        def strength(self) -> Tensor:
            return super().strength() + self.more() + self.rest

    camera = camera_of("pure")
    camera[0].lens.elements[2] = Changing().double()
    vergence = optics.ThinLens.vergence
    changes: list[Callable[[], Any]] = [
        lambda: None,
        lambda: Changing.more.__defaults__.__getitem__(0).__setitem__(0, 0.5),
        lambda: held.__setitem__(0, 0.7),
        lambda: setattr(Changing.rest.fget, "__code__", (lambda self: 0.4).__code__),
        lambda: monkeypatch.setattr(optics.ThinLens, "vergence", lambda self, grid: vergence(self, grid) + 0.05),
        monkeypatch.undo,
    ]
    with torch.no_grad():
        before = None
        for change in changes:
            change()
            picture = camera(scene_of())
            assert torch.equal(picture, anew(camera)(scene_of()))
            assert before is None or not torch.equal(picture, before)
            before = picture
        assert kept_as(camera[0].lens, camera[0].lens)


def test_what_is_handed_out_may_be_changed() -> None:
    stage, scene = camera_of("pixels")[0], scene_of()
    question = {"vergences": torch.tensor([1 / 1.2], dtype=DOUBLE), "shape": (9, 9), "like": scene.coefficients}
    with torch.no_grad():
        before = stage(scene)
        bank = stage.psf_bank(scene.wavelengths, **question)
        kept = bank.clone()
        bank.zero_()
        assert torch.equal(stage.psf_bank(scene.wavelengths, **question), kept)
        stage(scene).zero_()
        assert torch.equal(stage(scene), before)


def test_a_bank_of_ones_own_may_be_changed() -> None:
    """A renderer that is given a cache keeps transfer functions of what the PSFs were."""
    psfs, planes, cache = uniform(1, 3, 5, 5), uniform(1, 3, 8, 8), ValueCache()

    def picture(cache: ValueCache | None) -> Tensor:
        renderer = Renderer(psfs, spectra=None, weights=uniform(2, 3), picture=(8, 8), cache=cache)
        return renderer.blur(planes, layer=0)

    picture(cache)
    psfs[0, 1] *= 2
    assert torch.equal(picture(cache), picture(None))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_has_kept_nothing(copied: Callable[[Any], Any]) -> None:
    cache = ValueCache()
    first = cache.get(1, lambda: torch.zeros(1))
    assert cache.get(1, lambda: torch.ones(1)) is first
    assert float(copied(cache).get(1, lambda: torch.ones(1))) == 1


def test_looking_at_a_class_changes_nothing() -> None:
    """Python writes into a class what it was asked for: `__annotations__`, and `__slotnames__` for a copy."""
    camera = Camera.preset("phone")
    before = Settings(camera)
    classes = {cls for module in camera.modules() for cls in type(module).__mro__ if cls.__module__.startswith("kcam")}
    for cls in classes:
        for look in (pydoc.render_doc, inspect.getmembers, inspect.get_annotations, copyreg._slotnames):  # type: ignore[attr-defined]
            look(cls)
    assert any("__slotnames__" in vars(cls) for cls in classes)
    assert Settings(camera) == before


def test_while_nothing_changes_a_module_is_looked_at_once() -> None:
    """And again where it may have changed since."""
    lens, looks = next(stage for stage in Camera.preset("phone") if isinstance(stage, optics.Imaging)).lens, []

    def look() -> int:
        looks.append(len(looks))
        return len(looks)

    assert [seen(lens, "looks", look), seen(lens, "looks", look)] == [1, 2]
    tensors: list[Tensor] = []
    with unchanged():
        value = value_of(lens, tensors)
        assert seen(lens, "looks", look) == 3
        with unchanged():
            assert value_of(lens, again := []) is value
            assert [*map(id, again)] == [*map(id, tensors)]
            assert seen(lens, "looks", look) == 3
        assert seen(copy.deepcopy(lens), "looks", look) == 4
    assert value_of(lens, []) == value
    lens.another = 1
    assert value_of(lens, []) != value
    with unchanged():
        assert value_of(lens, []) != value


class Refocusing(optics.Lens):
    """It promises nothing, and moves its sensor once its window is known."""

    then = 0.0

    def bank(self, *asked: Any, **how: Any) -> Tensor:
        self.sensor_distance = self.then
        return super().bank(*asked, **how)


def test_of_what_may_change_while_it_is_used_nothing_is_kept() -> None:
    parts = optics.SquareAperture(4 * mm), optics.ThinLens(50 * mm)
    sharp, blurred = (optics.Lens(*parts, focus_distance=distance) for distance in (1.2, 0.3))
    lens = Refocusing(*parts, sensor_distance=sharp.sensor_distance)
    lens.then = blurred.sensor_distance
    scene = scene_of(bands=True)
    taken = optics.Imaging(lens, pixel_pitch=4 * um)(scene)
    window = optics.Imaging(sharp, pixel_pitch=4 * um).psf_window(
        scene.wavelengths, vergences=torch.tensor([1 / 1.2], dtype=DOUBLE), picture=scene.shape[1:]
    )
    expected = optics.Imaging(blurred, pixel_pitch=4 * um, psf_shape=window)(scene)
    torch.testing.assert_close(taken, expected)
    looks: list[int] = []
    with unchanged():
        for _ in range(2):
            seen(lens, "looks", lambda: looks.append(1))
    assert len(looks) == 2


def test_other_defaults_of_torch_are_other_values() -> None:
    cache = ValueCache()
    first = cache.get(1, lambda: torch.zeros(1))
    with torch.inference_mode():
        assert cache.get(1, lambda: torch.zeros(1)) is not first
    first = cache.get(1, lambda: torch.zeros(1))
    assert not first.is_inference()
    torch.set_default_dtype(DOUBLE)
    try:
        assert cache.get(1, lambda: torch.zeros(1)) is not first
    finally:
        torch.set_default_dtype(torch.float32)


def test_threads_get_what_they_asked_for() -> None:
    """One cache and two questions by turns: the answer to one is never given for the other."""
    cache, wrong, before = ValueCache(), [], sys.getswitchinterval()

    def ask(mine: float) -> None:
        for _ in range(4000):
            if float(cache.get(mine, lambda: torch.tensor(mine))) != mine:
                wrong.append(mine)

    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=ask, args=(value,)) for value in (1.0, 2.0)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
    assert not wrong


# ---- forward mode --------------------------------------------------------------------------------------------------


def lens_number(camera: Camera, value: Any) -> Scene:
    put(camera[0].lens.elements[1], "focal_length", value)
    return scene_of()


def distance(camera: Camera, value: Any) -> Scene:
    return scene_of(depth=value)


def alpha(camera: Camera, value: Any) -> Scene:
    put(camera[1], "coefficients", value * sensor.ColourFilter.kodak().coefficients.double(), buffer=True)
    return scene_of()


@pytest.mark.parametrize(("change", "at"), [(lens_number, 0.05), (distance, 1.2), (alpha, 1.0)])
@pytest.mark.parametrize("warm", [False, True])
def test_tangents_are_those_of_differences(change: Callable[[Camera, Any], Scene], at: float, warm: bool) -> None:
    """Through the lens, the distance and the filter, whether or not the same picture was taken before."""

    camera = camera_of("round")[:2].requires_grad_(False)

    def picture(value: Any) -> Tensor:
        return camera(change(camera, value))

    value, step = torch.tensor(at, dtype=DOUBLE), 1e-5 * at
    expected = (picture(value + step) - picture(value - step)) / (2 * step)
    if warm:
        picture(value)
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(picture(forward_ad.make_dual(value, torch.ones_like(value)))).tangent
    assert tangent is not None
    assert float((tangent - expected).abs().max()) < 1e-5 * float(expected.abs().max())
