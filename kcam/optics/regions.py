"""The field cut into zones: how much of each pixel belongs to each of some positions on the sensor.

Depth layers are one partition of a picture with shares that sum to 1, zones of the field another.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy
import torch
from torch import Tensor

_AT_ONCE = 2**16  # places beyond the nodes


def pixel_positions(picture: tuple[int, int], pixel_pitch: float) -> Tensor:
    """Where the light of each pixel of an upright picture falls on the sensor, (H, W, 2) of x, y [m]: turned about."""
    y, x = (-(torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * pixel_pitch for n in picture)
    return torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1)


def zones(planes: Tensor, positions: Tensor | None, *, pixel_pitch: float) -> Iterator[tuple[Tensor | None, Tensor]]:
    """Each of some positions (F, 2) on the sensor [m], as (1, 2), and what of the light of planes (..., H, W) falls
    there; without positions all of it.
    """
    if positions is None:
        yield None, planes
        return
    picture = (planes.shape[-2], planes.shape[-1])
    shares = field_shares(positions, pixel_positions(picture, pixel_pitch)).to(planes)
    for position, share in zip(positions, shares.unbind(-1), strict=True):
        if bool(share.any()):
            yield position[None], planes * share


def field_shares(nodes: Tensor, at: Tensor) -> Tensor:
    """Weights of the nodes (F, 2) at places (..., 2) that interpolate linearly, (..., F): >= 0, and they sum to 1.

    Bilinear where the nodes are a grid, barycentric in a Delaunay triangulation where they are scattered; beyond the
    outermost the nearest point between them counts, so that shares are continuous everywhere.
    """
    places = at.reshape(-1, 2).double().cpu().numpy()
    known = nodes.detach().double().cpu().numpy()
    x, y = np.unique(known[:, 0]), np.unique(known[:, 1])
    if len(known) == len(x) * len(y):
        weights = _along(x, places[:, 0])[:, np.searchsorted(x, known[:, 0])]
        weights = weights * _along(y, places[:, 1])[:, np.searchsorted(y, known[:, 1])]
    else:
        centre = known.mean(0)
        directions = np.linalg.svd(known - centre)
        if directions[1][1] <= 1e-9 * directions[1][0]:  # all on one line
            line = directions[2][0]
            order = np.argsort((known - centre) @ line)
            weights = np.empty((len(places), len(known)))
            weights[:, order] = _along(((known - centre) @ line)[order], (places - centre) @ line)
        else:
            weights = _scattered(known, places)
    return torch.as_tensor(weights).view(*at.shape[:-1], len(known))


def _along(nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Linear weights (P, n) of ascending nodes; those at the ends hold on beyond."""
    return np.stack([np.interp(places, nodes, one) for one in np.eye(len(nodes))], axis=1)


def _scattered(nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
    mesh = scipy.spatial.Delaunay(nodes)
    inside = mesh.find_simplex(places)
    weights = np.zeros((len(places), len(nodes)))
    beyond = np.flatnonzero(inside < 0)
    for part in np.split(beyond, range(_AT_ONCE, len(beyond), _AT_ONCE)):
        weights[part] = _on_hull(nodes, mesh.convex_hull, places[part])
    found = inside >= 0
    affine = mesh.transform[inside[found]]
    two = np.einsum("pij,pj->pi", affine[:, :2], places[found] - affine[:, 2])
    three = np.concatenate([two, 1 - two.sum(1, keepdims=True)], axis=1).clip(0)
    rows = np.flatnonzero(found)[:, None]
    weights[rows, mesh.simplices[inside[found]]] = three / three.sum(1, keepdims=True)
    return weights


def _on_hull(nodes: np.ndarray, edges: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Weights of the two nodes between which the nearest point of the hull lies."""
    start, along = nodes[edges[:, 0]], nodes[edges[:, 1]] - nodes[edges[:, 0]]
    position = np.einsum("pej,ej->pe", places[:, None] - start, along) / (along**2).sum(1)
    position = position.clip(0, 1)
    distance = ((places[:, None] - start - position[..., None] * along) ** 2).sum(-1)
    nearest = distance.argmin(1)
    share = position[np.arange(len(places)), nearest]
    weights = np.zeros((len(places), len(nodes)))
    rows = np.arange(len(places))
    weights[rows, edges[nearest, 0]] = 1 - share
    weights[rows, edges[nearest, 1]] += share
    return weights
