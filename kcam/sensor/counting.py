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
"""Means for which `counts` is right: the squeeze holds from 10, and the counts of float32 are fine up to here."""
COUNTED = 2.0**40
"""Electrons up to which torch.poisson is right: from 1e14 its variance is off, by 20 % at 1e16, and from 2^63 electrons
its counts overflow and are negative.
"""
_PIECE = 2**16
"""Numbers at a time, which stay in the processor's cache; always as many, for the same draws on any machine."""
_STEPS = 80
"""Of a sum for a mean below 10: what is left is below the last bit, and a sum that stays there never ends."""
_SHIFT, _HAT, _EDGE = 1.8, 0.1069, -0.6744


class _Poisson(torch.autograd.Function):
    @staticmethod
    def forward(rate: Tensor, generator: torch.Generator | None) -> Tensor:
        if can_count(rate):
            return counts(rate, generator)
        few = rate.device.type == "cpu" and not torch.compiler.is_compiling() and not (rate > COUNTED).any()
        counted = rate if few else rate.clamp(max=COUNTED)
        try:
            count = torch.poisson(counted, generator=generator)
        except RuntimeError as error:
            if not rate.isnan().any():
                raise
            raise ValueError(
                f"the signal has {int(rate.isnan().sum())} values that are NaN: photons cannot be counted. Remove NaN "
                "where it comes from, or use signal.nan_to_num(0)."
            ) from error
        if few:
            return count
        # beyond, the deviation has the same size in units of its own sigma
        return torch.where(rate > COUNTED, rate + (count - counted) * (rate / COUNTED).sqrt(), count)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.save_for_backward(inputs[0], output)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        rate, count = ctx.saved_tensors
        return grad * (1 + (count - rate) / (2 * rate.clamp(min=1))), None


def poisson(electrons: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
    """Count random independent arrivals: an exact Poisson draw, with a gradient to its expectation.

    N ~ Poisson(lambda),   dN/d lambda := 1 + (N - lambda) / (2 max(lambda, 1))

    It is the slope of lambda + sqrt(lambda) e at the e that gives this N, kept finite below one electron. Its mean is
    exactly 1 at every lambda, so the gradient of any loss linear in N is unbiased.

    Args:      electrons: expected number lambda >= 0, any shape, float32 or float64.
               generator: source of the draw, on the device of `electrons`; None for torch's default one.
    Returns:   whole numbers in the dtype of `electrons`. Above 2^40 they are normal: what is left of the Poisson's
               skewness there is 1e-6.

    Example:
    >>> electrons = torch.full((400, 400), 100.0, requires_grad=True)
    >>> counts = sensor.poisson(electrons, generator=torch.Generator().manual_seed(0))
    >>> counts.mean().backward()
    >>> counts = counts.detach()
    >>> round(float(counts.mean())), round(float(counts.std())), round(float(electrons.grad.sum()), 2)
    (100, 10, 1.0)
    """
    return _Poisson.apply(electrons, generator)


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
