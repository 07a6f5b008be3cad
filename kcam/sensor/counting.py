"""Poisson counts in bulk: where the mean is 10 or more, by a normal number that is corrected now and then.

torch.poisson draws number by number, 20 to 90 ns each. Here a whole tensor is counted at once, 2 to 4 times as fast. It
is exact but for what float32 holds: normal numbers end at 5.8 sigma, where 1e-8 is left, and the sums of small means
are good to 3e-7.

    k = floor(mu + s z),  z ~ N(0, 1), s = sqrt(mu):   q(k) = Phi((k + 1 - mu) / s) - Phi((k - mu) / s)
    accepted with probability min(1, p(k) / q(k)), p of Poisson's law; else k is drawn anew from (p - q)+

For k >= mu - 1.1484 p exceeds q, and below  p / q >= 1 - (mu - k)^3 / (6 mu^2):  a byte of chance settles nearly all of
it. The rest is drawn by rejection from t = (k - mu) / s of Laplace's law around 1.8, which lies above (p - q)+ when it
is multiplied by 0.1069 / mu. Means below 10 are counted by inversion: up to which k the sum of p is below a uniform
number.

Source:    Ahrens and Dieter, ACM Trans. Math. Softw. 8, 163 (1982), algorithm PD; there with series for p and q.
"""

from __future__ import annotations

import torch
from torch import Tensor

LEAST, MOST = 10.0, 2.0**23
"""Means for which it is right: the squeeze holds from 10, and the counts of float32 are fine up to here."""
_PIECE = 2**16
"""Numbers at a time, which stay in the processor's cache; always as many, for the same draws on any machine."""
_STEPS = 80
"""Of a sum for a mean below 10: what is left is below the last bit, and a sum that stays there never ends."""
_SHIFT, _HAT, _EDGE = 1.8, 0.1069, -0.6744


def can_count(means: Tensor) -> bool:
    """Whether `counts` is right for these; torch.poisson says what is wrong with others."""
    if means.device.type != "cpu" or means.dtype != torch.float32 or torch.compiler.is_compiling() or not means.numel():
        return False
    low, high = map(float, means.aminmax())
    return low >= 0 and high <= MOST


def counts(means: Tensor, generator: torch.Generator | None) -> Tensor:
    """Poisson counts, of the shape of the means, where these are >= 0, float32 and on the CPU: see `can_count`."""
    flat = means.reshape(-1)
    result = torch.empty_like(flat)
    bytes_ = flat.new_empty(-(-len(flat) // _PIECE) * _PIECE, dtype=torch.uint8)
    bytes_.view(torch.int64).random_(-(2**63), None, generator=generator)
    room = flat.new_empty(2, min(_PIECE, len(flat)))
    doubtful = []
    for index, (mean, count) in enumerate(zip(flat.split(_PIECE), result.split(_PIECE), strict=True)):
        if float(mean.max()) < LEAST:
            count.copy_(_inverted(mean, generator))
            continue
        deviation, doubt = room[:, : len(mean)]
        torch.sqrt(mean, out=deviation)
        whole = torch.floor(mean, out=doubt)
        count.normal_(generator=generator).mul_(deviation).add_(mean - whole).floor_().add_(whole)
        # (mu - k)^3 - 6 mu^2 u, with the least u that its first byte allows
        torch.sub(mean, count, out=doubt).pow_(3)
        least = deviation.copy_(bytes_[index * _PIECE :][: len(mean)])
        doubt.addcmul_(least.mul_(mean), mean, value=-6 / 256)
        doubt.add_(torch.lt(mean, LEAST, out=deviation), alpha=torch.finfo(torch.float32).max / 2)
        doubtful.append((doubt > 0).nonzero().flatten() + index * _PIECE)
    open_ = torch.cat(doubtful) if doubtful else bytes_.new_empty(0, dtype=torch.int64)
    mean, few = flat[open_], flat[open_] < LEAST
    if few.any():
        result[open_[few]] = _inverted(mean[few], generator)
    many = open_[~few]
    result[many] = _settled(flat[many], result[many], bytes_[many], generator)
    return result.view_as(means)


def _inverted(means: Tensor, generator: torch.Generator | None) -> Tensor:
    """Counts of means (N,) below `LEAST`: how many steps of the distribution's sum lie below a uniform number."""
    found = torch.zeros_like(means)
    for mean, count in zip(means.split(_PIECE), found.split(_PIECE), strict=True):
        term = torch.exp(-mean)
        missing = torch.empty_like(mean).uniform_(generator=generator).sub_(term)  # u - F(k)
        above = torch.empty_like(mean)
        for k in range(1, _STEPS):
            count.add_(torch.gt(missing, 0, out=above))
            missing.sub_(term.mul_(mean).mul_(1 / k))
            if k % 4 == 0 and float(missing.max()) <= 0:
                break
    return found


def _settled(mean: Tensor, count: Tensor, byte: Tensor, generator: torch.Generator | None) -> Tensor:
    """The counts that a byte did not settle, (N,) each."""
    mu, k = mean.double(), count.double()
    u = (byte + torch.empty_like(mu).uniform_(generator=generator)) / 256
    open_ = ((mu - k) ** 3 > 6 * mu.square() * u).nonzero().flatten()
    mu, k, u = mu[open_], k[open_], u[open_]
    poisson, normal = _laws(mu, k)
    rejected = open_[(1 - u) * normal > poisson]
    return count.index_copy(0, rejected, _remaining(mean[rejected].double(), generator).to(count))


def _remaining(mu: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draws from (p - q)+, (N,) float64."""
    found, waiting = torch.empty_like(mu), torch.arange(len(mu), device=mu.device)
    while len(waiting):
        mean = mu[waiting]
        side, height, far = mean.new_empty(3, len(mean)).uniform_(generator=generator)
        away = -torch.log1p(-far)
        t = _SHIFT + torch.where(side < 0.5, -away, away)
        k = torch.floor(mean + mean.sqrt() * t)
        poisson, normal = _laws(mean, k)
        accepted = (t > _EDGE) & (_HAT / mean * height <= (poisson - normal) * away.exp())
        found[waiting[accepted]] = k[accepted]
        waiting = waiting[~accepted]
    return found


def _laws(mu: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """p(k) and q(k); of what is below 0, 0 and q(k)."""
    deviation = mu.sqrt()
    low, high = (k - mu) / deviation, (k + 1 - mu) / deviation
    flipped = torch.where(low > 0, -1.0, 1.0)  # differences of small numbers, not of ones
    normal = flipped * (torch.special.ndtr(flipped * high) - torch.special.ndtr(flipped * low))
    inside = k.clamp(min=0)
    poisson = torch.where(k < 0, 0.0, (inside * mu.log() - mu - torch.lgamma(inside + 1)).exp())
    return poisson, normal
