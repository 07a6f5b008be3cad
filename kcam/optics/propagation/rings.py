"""Radial functions that are smooth in panels only: profiles of rings, wrapped, noisy or stepped.

A profile is smooth between its knots. Gauss-Legendre nodes in each panel between two of them integrate it as exactly as
one rule does a smooth pupil; nodes spread over the whole radius do not, however many.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from kcam.cache import ValueCache
from kcam.optics.numerics import legendre, phasor

_MOST_PANELS = 2**14
_FINEST = 2.0**-26  # width of a panel around a step that no panel resolves: of no weight any more
_RESOLVED = 1e-6  # of the highest Legendre coefficients of a phase in a panel [rad]
_CHECKED = 16  # nodes by which a panel is judged
_LOOKED_AT = 2**16  # places along the radius at which narrow structure is looked for
_BEND = 1e-3  # between three of these: what is bent more, nodes of a wide panel may not see [rad]
_MOST_SPECTRUM = 2**17  # samples of a radius
_TURNS = 200  # of a kernel, that the polynomials of one part of the radius follow
_POLYNOMIALS = ValueCache(2)  # the last of these at the nodes: other distances have the same nodes


def panels_of(phase: Callable[[Tensor], Tensor], knots: Tensor, *, first: int = 32) -> Tensor:
    """Edges of panels in which a phase of unknown structure is smooth: halved until its Legendre series has ended.

    Args:      phase: (n,) radii to (..., n) [rad]. knots: where it is known not to be smooth, in [0, 1].
               first: equal panels to begin with.
    Returns:   (K,) ascending from 0 to 1. A step is closed in on to 2^-26 of the radius; a groove narrower than 2^-16
               of it may be missed.
    Raises:    ValueError for a phase that more than 2^14 panels do not resolve.
    """
    places, weights = legendre(_CHECKED)
    orders = np.arange(_CHECKED)
    series = np.polynomial.legendre.legvander(places, _CHECKED - 1) * weights[:, None] * (orders + 0.5)
    at_ends = np.vstack([series @ np.stack([(-1.0) ** orders, 1.0**orders], axis=1), -np.eye(2)])
    judged = np.hstack([np.vstack([series[:, -4:], np.zeros((2, 4))]), 1e-2 * at_ends])  # ends: to 1e-4 rad
    last, nodes = torch.as_tensor(judged).to(knots), torch.as_tensor(places).to(knots)
    equal = torch.linspace(0, 1, first + 1, dtype=knots.dtype, device=knots.device)
    edges = torch.cat([equal, knots]).unique()
    low, high = edges[:-1], edges[1:]
    looked_at = torch.linspace(0, 1, _LOOKED_AT + 1, dtype=knots.dtype, device=knots.device)
    bends = phase(looked_at).diff(n=2).abs().flatten(0, -2).amax(0) > _BEND
    bends = looked_at[1:-1][bends]  # one groove in a wide panel may lie between its nodes
    while low.numel():
        if edges.numel() > _MOST_PANELS:
            raise ValueError(
                f"the rotationally symmetric path is not smooth in {_MOST_PANELS} panels between 0 and the rim. Let "
                "its element name the radii between which it is, as `knots`, or make its structure coarser."
            )
        centre, half = (low + high) / 2, (high - low) / 2
        inside = centre[:, None] + half[:, None] * nodes
        seen = torch.cat([inside, low[:, None] + _FINEST / 4, high[:, None] - _FINEST / 4], dim=1)
        values = phase(seen.flatten()).unflatten(-1, (-1, _CHECKED + 2))
        rough = ((values @ last).abs().amax(-1) > _RESOLVED).flatten(0, -2).any(0) & (2 * half > _FINEST)
        rough |= (torch.searchsorted(bends, low) < torch.searchsorted(bends, high)) & (2 * half > 16 / _LOOKED_AT)
        low, high, centre = low[rough], high[rough], centre[rough]
        edges = torch.cat([edges, centre])
        low, high = torch.cat([low, centre]), torch.cat([centre, high])
    return edges.sort().values


def panel_orders(edges: Tensor, phase: Callable[[Tensor], Tensor], *, frequency: float, density: float = 1.0) -> Tensor:
    """Nodes for each panel that integrate exp(i phase) cos(frequency rho) to 1e-9, (K - 1,).

    Args: edges: (K,) of the panels; phase: (n,) radii to (..., n) [rad]; frequency: [rad per unit of radius].
    """
    checked = max(12, math.ceil(97 / (edges.numel() - 1)))
    nodes = torch.as_tensor(legendre(checked)[0]).to(edges)
    centre, half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
    values = phase((centre[:, None] + half[:, None] * nodes).flatten()).unflatten(-1, (-1, checked))
    steepest = (values.diff() / nodes.diff()).abs().flatten(0, -3).amax(dim=(0, 2))  # over half a panel
    turns = frequency * half + steepest
    return torch.ceil(density * (turns + torch.clamp(5 + 6 * turns ** (1 / 3), max=32.0)))


def panel_nodes(edges: Tensor, orders: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights of panels with so many nodes each; the edges may carry a gradient."""
    centre, half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
    nodes, weights = [], []
    orders = 2 * torch.ceil(orders / 2).long()
    for order in orders.unique().tolist():
        rule = [torch.as_tensor(v).to(edges) for v in legendre(order)]
        own = orders == order
        nodes.append((centre[own, None] + half[own, None] * rule[0]).flatten())
        weights.append((half[own, None] * rule[1]).flatten())
    return torch.cat(nodes), torch.cat(weights)


def fewer_nodes(values: Tensor, nodes: Tensor, *, frequency: float) -> tuple[Tensor, Tensor]:
    """The same integral against any cos(t rho), t <= frequency, by no more nodes than that needs.

    What a transform sees of a pupil is its projection onto the polynomials that follow the kernel, however fine the
    pupil is.

    Args:      values: (..., n) field times quadrature at the nodes (n,), up to 1.
    Returns:   values (..., m) and nodes (m,); as they were where m is no less.
    """
    low = float(nodes.detach().min())
    whole = frequency * (1 - low) / 2
    parts = max(1, math.ceil(whole / _TURNS))
    turns = whole / parts
    count = math.ceil(turns + min(48, 12 + 8 * turns ** (1 / 3)))
    if 1.5 * count * parts > nodes.numel() or nodes.requires_grad:
        return values, nodes
    places, weights = legendre(count)
    coarse = np.polynomial.legendre.legvander(places, count - 1)
    back = torch.as_tensor(coarse.T * weights * (np.arange(count)[:, None] + 0.5)).to(nodes)

    def polynomials() -> tuple[tuple[Tensor, Tensor], ...]:
        inside = (nodes - low) * (parts / (1 - low))
        part, found = inside.long().clamp(max=parts - 1), []
        for own in range(parts):
            chosen = (part == own).nonzero()[:, 0]
            fine = np.polynomial.legendre.legvander((2 * (inside[chosen] - own) - 1).cpu().numpy(), count - 1)
            found.append((chosen, torch.as_tensor(np.ascontiguousarray(fine)).to(nodes)))
        return tuple(found)

    kept = _POLYNOMIALS.get((nodes, parts, count), polynomials)
    projected = [values[..., chosen] @ fine @ back for chosen, fine in kept]
    starts = torch.arange(parts, dtype=nodes.dtype, device=nodes.device)[:, None]
    fewer = (torch.as_tensor(places).to(nodes) + 1) / 2 + starts
    return torch.cat(projected, dim=-1), low + (1 - low) / parts * fewer.flatten()


@dataclass(frozen=True)
class Scatter:
    """How far the structure of a radius spreads light, without what its rim diffracts.

    frequency: (F,) ascending [cycles per unit of radius]; beyond: (P, F) share of the power beyond it, for each phase.
    """

    frequency: Tensor
    beyond: Tensor

    def reach(self, share: float) -> Tensor:
        """Frequency beyond which so much of the light lies, (P,)."""
        return self.frequency[(self.beyond > share).sum(-1).clamp(max=self.frequency.numel() - 1)]

    def share(self, frequency: float) -> Tensor:
        """Share of the light beyond a frequency, (P,)."""
        return self.beyond[:, min(int((self.frequency < frequency).sum()), self.frequency.numel() - 1)]


def scatter(edges: Tensor, phase: Callable[[Tensor], Tensor]) -> Scatter:
    """The spectrum of exp(i phase) along a diameter, its rim faded out from half the radius on.

    Args: edges: of its panels; phase: (n,) radii to (P, n) [rad].
    """
    widths = edges.diff()
    widths = widths[widths > 8 / _MOST_SPECTRUM]
    finest = float(widths.min()) if widths.numel() else 0.0
    count = 2**10
    while True:
        radius = torch.arange(count, dtype=edges.dtype, device=edges.device) / count
        angle = phase(radius)
        resolved = count * finest >= 8 and float(angle.diff(dim=-1).abs().max()) <= 1.5
        if resolved or count == _MOST_SPECTRUM:
            break
        count *= 2
    fade = torch.as_tensor(scipy.special.erfc((radius.cpu().numpy() - 0.65) / 0.1)).to(radius)
    field = phasor(angle) * fade
    diameter = torch.cat([field, field.new_zeros(field.shape[0], 1), field[:, 1:].flip(-1)], dim=-1)
    power = torch.fft.fft(diameter)[:, : count + 1].abs().square()
    power[:, 1:] *= 2
    beyond = power.flip(-1).cumsum(-1).flip(-1) / power.sum(-1, keepdim=True)
    return Scatter(torch.arange(count + 1, dtype=edges.dtype, device=edges.device) / 2, beyond)
