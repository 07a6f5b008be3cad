"""Results that are kept while what they were computed from has not changed - by value, so never stale.

What a value is, is decided here, once, for everything that a lens or a stage can hold (`value_of`):

- numbers, text, None, dtypes and devices by type and bits, as are tensors and numpy arrays;
- tuples, lists, dicts and sets by what is in them;
- modules of kcam and torch.nn by their class and by all that they hold, plain attributes and torch's own alike; so are
  kcam's dataclasses;
- kcam's functions by their code and what they closed over;
- what only remembers results (`remembers`) by its class.

What else there is cannot be known, and then nothing is kept and all is computed again: other objects and functions
(hooks and methods put onto an instance among them), tensors of other kinds, parametrizations, which may draw, and
modules of all other classes, whose methods may read a global, a closure or a file. Such a class may promise that they
do not, see `optics.Element`. Nor is anything kept or used that a derivative passes through: of a graph, of forward
mode, or of a transform of `torch.func`.

Left to whoever does so: changing kcam's functions and constants themselves.
"""

from __future__ import annotations

import contextlib
import operator
import types
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextvars import ContextVar
from dataclasses import is_dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

_PLAIN = {type(None), bool, int, str, bytes, torch.dtype, torch.device, torch.layout, torch.memory_format}
_CONTAINERS = {tuple, list, dict, OrderedDict, set, frozenset, torch.Size}
_CODE = (types.FunctionType, property, classmethod, staticmethod)
_IN_PYTHON = 1 << 9  # the flag of classes that are not compiled
_DEFINED: dict[type, tuple[tuple[Any, ...], ...]] = {}  # by `_members`
_INTEGERS = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


T = TypeVar("T")
_SEEN: ContextVar[dict[tuple[int, Hashable], tuple[Any, Any]] | None] = ContextVar("seen", default=None)


class Unknown(Exception):
    """Something is held whose value cannot be told."""


@contextlib.contextmanager
def unchanged() -> Iterator[None]:
    """While no module changes: what is `seen` of each is then looked at once, not whenever it is asked."""
    token = _SEEN.set(_SEEN.get() or {})
    try:
        yield
    finally:
        _SEEN.reset(token)


def seen(thing: object, what: Hashable, look: Callable[[], T]) -> T:
    """What a look at a thing finds, which is kept while all is `unchanged`, if it can be known what the thing is."""
    if _SEEN.get() is None or not _seen(thing, "known", lambda: _is_known(thing)):
        return look()
    return _seen(thing, what, look)


def _seen(thing: object, what: Hashable, look: Callable[[], T]) -> T:
    known = _SEEN.get()
    if known is None:
        return look()
    key = id(thing), what
    if key not in known:
        known[key] = thing, look()  # held, for another may get its id
    return known[key][1]  # type: ignore[no-any-return]


def _is_known(thing: object) -> bool:
    try:
        value_of(thing, [])
    except Unknown:
        return False
    return True


def differentiated(tensor: Tensor) -> bool:
    """Whether a derivative passes through a tensor: backwards by a graph, or forwards by a tangent."""
    return tensor.requires_grad or _has_tangent(tensor)


def _has_tangent(tensor: Tensor) -> bool:
    return forward_ad.unpack_dual(tensor).tangent is not None


def value_of(thing: Any, tensors: list[Tensor], *, within: tuple[int, ...] = ()) -> Any:
    """What a thing is by value, to compare with `==`; its tensors come into `tensors`, to compare by their bits.

    Raises: `Unknown` where that cannot be told.
    """
    if not isinstance(thing, nn.Module):
        return _value_of(thing, tensors, within)

    def look() -> tuple[Any, list[Tensor]]:
        own: list[Tensor] = []
        return _value_of(thing, own, within), own

    value, own = _seen(thing, "value", look)
    tensors += own
    return value


def _value_of(thing: Any, tensors: list[Tensor], within: tuple[int, ...]) -> Any:
    kind = type(thing)
    if kind in _PLAIN:
        return kind, thing
    if kind in _CONTAINERS and not thing:  # most of what torch keeps in a module
        return kind
    if kind in (float, complex):
        return kind, repr(thing)  # tells -0.0 from 0.0, and one NaN is the other
    if isinstance(thing, Tensor):
        usual = kind in (Tensor, nn.Parameter) and thing.layout is torch.strided and not thing.is_meta
        if not usual or thing.is_nested or thing.is_quantized:
            raise Unknown(f"a {kind.__name__} that is not plain")
        tensors.append(thing)
        return kind, thing.dtype, thing.device, thing.shape, thing.requires_grad
    if getattr(kind, "remembers", False) is True and _ours(kind):
        return kind  # what is kept changes no result
    if id(thing) in within:
        raise Unknown(f"a {kind.__name__} that holds itself")
    within = (*within, id(thing))

    def each(members: Iterable[Any]) -> list[Any]:
        return [value_of(member, tensors, within=within) for member in members]

    if kind in (dict, OrderedDict):
        return kind, each(thing), each(thing.values())
    if kind in (tuple, list, torch.Size):
        return kind, each(thing)
    if kind in (set, frozenset) and all(type(member) in _PLAIN for member in thing):
        return kind, frozenset((type(member), member) for member in thing)
    record = is_dataclass(kind) and _ours(kind)
    if record or isinstance(thing, nn.Module) or getattr(kind, "pure", False) is True:
        code, data = _of_classes(kind)
        return kind, code, each(data), list(vars(thing)), each(vars(thing).values())
    if isinstance(thing, np.ndarray | np.generic) and kind.__module__ == "numpy" and not thing.dtype.hasobject:
        return kind, thing.dtype, thing.shape, thing.tobytes()
    where = thing.__globals__.get("__name__", "") if kind is types.FunctionType else ""  # code that is run has no name
    if where.startswith("kcam."):
        closed = [cell.cell_contents for cell in thing.__closure__ or ()]
        return where, thing.__code__, each((thing.__defaults__, thing.__kwdefaults__, closed))
    raise Unknown(kind.__name__)


def _ours(cls: type) -> bool:
    return cls.__module__.startswith(("kcam.", "torch.nn.modules."))


def _of_classes(kind: type) -> tuple[list[Any], list[Any]]:
    """Code, by identity, and data that instances have from classes: those of others must promise, see `Element`."""
    code: list[Any] = [_members(cls) for cls in kind.__mro__ if _ours(cls)]
    data: list[Any] = []
    others = [cls for cls in kind.__mro__[:-1] if not _ours(cls)]
    if others and vars(kind).get("pure") is not True:
        raise Unknown(f"{kind.__name__}, which promises nothing")
    for cls in others:
        if "__slots__" in vars(cls) or not cls.__flags__ & _IN_PYTHON:
            raise Unknown(f"{cls.__name__}, which holds more than its attributes")
        for name, value in vars(cls).items():
            if isinstance(value, _CODE):
                code.append(value)
                for function in (value, *(getattr(value, of, None) for of in ("__func__", "fget"))):
                    if isinstance(function, types.FunctionType):
                        code.append(function.__code__)
                        data += [function.__defaults__, function.__kwdefaults__, *_closed_over(function)]
            elif not name.startswith("__"):
                data += [name, value]
    return code, data


def _members(cls: type) -> tuple[Any, ...]:
    """What a class of ours defines; not what Python writes beside it when asked: annotations, or names of slots.

    It is kept while the class holds the very same objects: each key asks all classes of a lens.
    """
    names, values = tuple(vars(cls)), tuple(vars(cls).values())
    known = _DEFINED.get(cls)
    if known is None or names != known[0] or not all(map(operator.is_, values, known[1])):
        pairs = zip(names, values, strict=True)
        some = (value for name, value in pairs if not name.startswith("__") or isinstance(value, _CODE))
        _DEFINED[cls] = known = names, values, tuple(some)
    return known[2]


def _closed_over(function: types.FunctionType) -> list[Any]:
    """What a function closed over, but for its class, which super() needs."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return [cell.cell_contents for name, cell in cells if name != "__class__"]


class Settings:
    """What a module is at a time, beside what it trains: all that it holds, but for the values of what requires grad.

    Of a part that cannot be known, itself and its own parts count: for decisions that a module's parts live on in.
    """

    def __init__(self, module: nn.Module) -> None:
        tensors: list[Tensor] = []
        self.plain = (_settings_of(module, tensors), torch.is_grad_enabled())
        self.tensors = tuple(tensor.detach().clone() for tensor in tensors if not tensor.requires_grad)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Settings) or self.plain != other.plain:
            return False
        return all(map(_same_bits, self.tensors, other.tensors))

    __hash__ = None  # type: ignore[assignment]


def _settings_of(thing: Any, tensors: list[Tensor]) -> Any:
    found: list[Tensor] = []
    try:
        value = value_of(thing, found)
    except Unknown:
        if not isinstance(thing, nn.Module):
            return [thing]
        own = {name: part for name, part in vars(thing).items() if name != "_modules"}
        return thing, [_settings_of(part, tensors) for part in (*own.values(), *thing.children())]
    tensors += found
    return value


class ValueCache:
    """The last results, tensors or dataclasses of kcam that hold some, and the values that they were computed from.

    entries: how many.
    """

    remembers = True  # see `value_of`

    _kept: tuple[tuple[Any, tuple[Tensor, ...], Any], ...] = ()  # set and read at once: other threads use it too

    def __init__(self, entries: int = 1) -> None:
        self.entries = entries

    def get(self, key: Any, build: Callable[[], T]) -> T:
        """The kept result if `key`, of whatever it depends on, has the value of one of the kept, else a new one.

        It must not be changed in place. Inference mode has a result of its own, which autograd refuses outside.
        """
        tensors: list[Tensor] = []
        try:
            if torch._C._are_functorch_transforms_active():  # even what is created inside is wrapped there
                raise Unknown("a transform of torch.func")
            modes = (torch.is_inference_mode_enabled(), torch.get_default_dtype(), torch.get_default_device())
            key = (value_of(key, tensors), modes)
        except Unknown:
            return build()
        if any(map(recorded, tensors)):
            return build()
        bits = [*map(_bits, tensors)]
        for kept in self._kept:
            if kept[0] == key and all(map(torch.equal, kept[1], bits)):
                return kept[2]  # type: ignore[no-any-return]
        before = tuple(own.clone() for own in bits)
        value = build()
        if not has_derivative(value):
            self._kept = ((key, before, value), *self._kept)[: self.entries]
        return value

    def __reduce__(self) -> tuple[type[ValueCache], tuple[int]]:
        """A copy has kept nothing."""
        return ValueCache, (self.entries,)


def has_derivative(value: Any) -> bool:
    """Whether a derivative passes through a result, or might."""
    tensors: list[Tensor] = []
    try:
        value_of(value, tensors)
    except Unknown:
        return True
    return any(map(differentiated, tensors))


def recorded(tensor: Tensor) -> bool:
    """Whether what is computed from a tensor now carries a derivative; no_grad stops graphs, but not tangents."""
    return (tensor.requires_grad and torch.is_grad_enabled()) or _has_tangent(tensor)


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor is numbers and no more: no derivative is recorded, no transform of torch.func nor the compiler
    looks on. What is made of it may be worked on in place.
    """
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return False
    return not recorded(tensor)


def _same_bits(a: Tensor, b: Tensor) -> bool:
    """Of tensors alike in type, shape and device; 0 is not -0, and a NaN is itself."""
    return torch.equal(_bits(a), _bits(b))


def _bits(tensor: Tensor) -> Tensor:
    real = torch.view_as_real(tensor.resolve_conj()) if tensor.is_complex() else tensor
    return real.detach().resolve_neg().view(_INTEGERS[real.element_size()])
