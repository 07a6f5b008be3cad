"""Imaging as a linear map: of light of any sign, with all that is decided by the look of a scene decided by one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from kcam.cache import ValueCache
from kcam.optics.field import FieldPicture
from kcam.optics.imaging import Absorber, Imaging
from kcam.optics.source import FieldPSFs
from kcam.precision import full_precision
from kcam.scene import Scene

_KEPT = 4  # decisions over the field: of samples at distances of their own, and of two dtypes

_constant: ContextVar[bool] = ContextVar("constant", default=False)


class LinearImaging(Imaging):
    """An Imaging as a linear map: no floor at 0, and what it decides by the look of a scene is decided by one scene."""

    @classmethod
    def of(cls, imaging: Imaging) -> LinearImaging:
        """The same stage, which shares the lens and what was traced."""
        own = cls(**imaging.configuration())
        own._traced_cache, own._window_cache = imaging._traced_cache, imaging._window_cache
        own._reach, own._warns = imaging._reach, False
        own._decisions = ValueCache(_KEPT)
        return own

    def light(self, x: Tensor, scene: Scene, colour_filter: Absorber | None) -> Tensor:
        """What `forward` gives of a scene with these planes, in the dtype that this one is computed in, or a finer."""
        with _optics():
            contraction = None if colour_filter is None else colour_filter.contraction(scene.wavelengths)
            working = torch.promote_types(x.dtype, self.working(scene).dtype)
        with full_precision(x.device):
            light = self._render(scene, x.to(working), contraction)
        return light if colour_filter is None else colour_filter.finish(light)

    def _finished(self, light: Tensor, weights: Tensor | None, afterwards: Tensor | None) -> Tensor:
        return light if afterwards is None else torch.einsum("cl,blyx->bcyx", afterwards, light)

    def _grouped_bank(self, nodes: Tensor, **arguments: Any) -> Tensor:
        with _optics():
            return super()._grouped_bank(nodes, **arguments)

    def _traced(self, *arguments: Any) -> FieldPSFs:
        with _optics():
            return super()._traced(*arguments)

    def _over_field(self, *arguments: Any, **others: Any) -> FieldPSFs:
        with _optics():
            return super()._over_field(*arguments, **others)

    def _field_picture(self, scene: Scene, *, vergences: Tensor, weights: Tensor | None, like: Tensor) -> FieldPicture:
        field = super()._field_picture(scene, vergences=vergences, weights=weights, like=like)

        def decide() -> Any:
            planes = self.working(scene).to(like)
            return field.how(*field.moved(planes, self.layers_of(scene, planes)[1]))

        with _optics():
            how = self._decisions.get((self, scene, vergences, weights, like.dtype, like.device), decide)
        return _Decided(**{own.name: getattr(field, own.name) for own in fields(field)}, decided=how)


@dataclass(frozen=True)
class _Decided(FieldPicture):
    """One whose places of PSFs are decided."""

    decided: Any = None

    def how(self, planes: Tensor, shares: Tensor | None) -> Any:
        """What was decided."""
        return self.decided


@contextlib.contextmanager
def constant_optics() -> Iterator[None]:
    """Where the optics are what they are: a transpose is linear in the light alone, so that also of a lens that trains
    the PSFs are those that are kept.
    """
    token = _constant.set(True)
    try:
        yield
    finally:
        _constant.reset(token)


def _optics() -> contextlib.AbstractContextManager[Any]:
    """Where the optics' own values are computed."""
    return torch.no_grad() if _constant.get() else contextlib.nullcontext()
