"""Windows' columns on a GPU: inner products of all windows at once, again and again while only
their residuals change.

On a CPU each window is reduced by itself, on all cores, as
:mod:`visthrow.diagnose.likelihood.marginal` has it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch

from visthrow.diagnose.likelihood.marginal import (
    DeviceArray,
    Gram,
    check,
    correlated,
    correlated_with,
    gram_of,
    gram_with,
    knot_factor,
    left_of,
    with_products,
    with_residual,
)
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.likelihood.transfer import all_to_host, side_by_side, to_host
from visthrow.diagnose.models.model_interface import Window

T = TypeVar("T", np.ndarray, torch.Tensor)


class Same(tuple):
    """Arrays that are the same only if they are the very ones."""

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Same)
            and len(self) == len(other)
            and all(a is b for a, b in zip(self, other))
        )

    def __hash__(self) -> int:
        return hash(tuple(map(id, self)))


class _Design:
    """Columns of W windows over their sigmas, on a device; padded with 0 to N samples and P
    columns.
    """

    def __init__(
        self,
        windows: Sequence[tuple[np.ndarray, ...]],
        floors: np.ndarray,
        channels: int,
        device: str,
    ):
        """Move them there, where they are also scaled.

        ``windows``: of each, its nuisances, latents, effects, deviations of nuisances, sigmas and
        channels; ``floors``: of the effects, shape (K,)."""
        self._widths = [sum(parts.shape[1] for parts in own[:3]) for own in windows]
        shape, width = (len(windows), max(len(own[4]) for own in windows)), max(self._widths)
        sigma, member, scale = (
            np.ones(shape),
            np.zeros((*shape, channels)),
            np.zeros((len(windows), width)),
        )
        for w, (*parts, sd, own_sigma, channel) in enumerate(windows):
            scale[w, : self._widths[w]] = np.concatenate((sd, np.ones(parts[1].shape[1]), floors))
            sigma[w, : len(own_sigma)] = own_sigma
            member[w, np.arange(len(channel)), channel] = 1.0
        self._sigma, self._member, scales = (
            torch.from_numpy(a).to(device) for a in (sigma, member, scale)
        )
        columns = side_by_side([own[:3] for own in windows], (shape[1], width), device)
        self._columns = columns.mul_(scales[:, None]).div_(self._sigma[:, :, None])

    def inner(self) -> list[DeviceArray]:
        """Inner products of each window's columns by channel, shape (C, P, P)."""
        count, _, channels = self._member.shape
        products = self._columns.new_empty(
            (count, channels, self._columns.shape[2], self._columns.shape[2])
        )
        for c in range(channels):
            torch.matmul(
                (self._columns * self._member[:, :, c, None]).transpose(1, 2),
                self._columns,
                out=products[:, c],
            )
        return _on_both(products, self._widths)

    def left(self, residuals: Sequence[np.ndarray], fits: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return each window's residual after fits of the first columns, shape (N,)."""
        fit = np.zeros((len(fits), self._columns.shape[2]))
        for row, fit_of in zip(fit, fits):
            row[: len(fit_of)] = fit_of
        explained = self._columns @ torch.from_numpy(fit).to(self._sigma.device)[:, :, None]
        residual_after = ((self._off(residuals) - explained[:, :, 0]) * self._sigma).cpu().numpy()
        return [fit_of[: len(residual)] for fit_of, residual in zip(residual_after, residuals)]

    def _off(self, residuals: Sequence[np.ndarray]) -> torch.Tensor:
        """Residuals over sigmas, shape (W, N)."""
        padded = np.zeros(self._sigma.shape)
        for row, residual in zip(padded, residuals):
            row[: len(residual)] = residual
        return torch.from_numpy(padded).to(self._sigma.device) / self._sigma

    def products(self, residuals: Sequence[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Inner products of each window's residual with its columns (C, P), and with
        itself (C,).
        """
        off = self._off(residuals)
        by_channel = (self._member * off[:, :, None]).transpose(1, 2)
        cross, square = all_to_host(
            (by_channel @ self._columns, (by_channel @ off[:, :, None])[..., 0])
        )
        return (
            (products_of[:, :width], its)
            for products_of, width, its in zip(cross, self._widths, square)
        )


def _designed(windows: Sequence[Window], floors: np.ndarray, channels: int, device: str) -> _Design:
    """The windows' columns there: of the very same arrays, once."""
    arrays = [
        a
        for w in windows
        for a in (w.nuisance, w.latent, w.effects, w.nuisance_sd, w.sigma, w.channel)
    ]
    return _cached_design(Same([*arrays, floors]), channels, device)


@lru_cache(maxsize=2)
def _cached_design(arrays: Same, channels: int, device: str) -> _Design:
    return _Design(
        [arrays[i : i + 6] for i in range(0, len(arrays) - 1, 6)], arrays[-1], channels, device
    )


def grams_of(
    windows: Sequence[Window], floors: np.ndarray, channels: int, device: str
) -> list[Gram]:
    """Reduce windows to their inner products, see
    :func:`visthrow.diagnose.likelihood.marginal.gram_of`.

    ``windows``: with finite residuals and derivatives; ``floors``: of the effects, shape (K,).
    Raises DiagnoseError: a window's arrays do not fit together, or hold NaN or infinity.
    """
    if device == "cpu" or not windows or _correlated(windows):
        return parallel_map(lambda w: gram_of(w, floors, channels), windows)
    parallel_map(lambda w: check(w, len(floors), channels), windows)
    design = _designed(windows, floors, channels, device)
    products = zip(windows, design.inner(), design.products([w.residual for w in windows]))
    return [
        replace(gram_with(w, inner.of, cross, square), there=inner)
        for w, inner, (cross, square) in products
    ]


def _correlated(windows: Sequence[Window]) -> bool:
    """Whether noise of windows is to be whitened, which is done on the CPU."""
    return any(window.correlated for window in windows)


def _on_both(values: torch.Tensor, widths: Sequence[int]) -> list[DeviceArray]:
    """Square matrices of some channels, shape (W, C, P, P), as far as they are not padded."""
    return [
        DeviceArray(device_values[:, :n, :n], host[:, :n, :n])
        for device_values, host, n in zip(values, to_host(values), widths)
    ]


def padded(
    inner: Sequence[DeviceArray | np.ndarray],
    part: Callable[[T, int], T],
    shape: tuple[int, ...],
    device: str,
) -> torch.Tensor:
    """Parts of grams' inner products one beside the other, each padded with zeros, shape (grams,
    *shape).

    ``inner``: of the grams, see :attr:`Gram.placed`; ``part``: of one gram's, given its number;
    ``shape``: to pad to."""
    if not any(isinstance(product, DeviceArray) for product in inner):
        return side_by_side([[part(product, i)] for i, product in enumerate(inner)], shape, device)
    out = torch.zeros((len(inner), *shape), dtype=torch.float64, device=device)
    for i, product in enumerate(inner):
        values = (
            part(product.values, i)
            if isinstance(product, DeviceArray)
            else torch.tensor(part(product, i), device=device)
        )
        out[(i, *map(slice, values.shape))] = values
    return out


def correlated_of(
    grams: Sequence[Gram], windows: Sequence[Window], time: float, device: str
) -> list[Gram]:
    """Correlate the latent forces of all windows, see
    :func:`visthrow.diagnose.likelihood.marginal.correlated`.

    ``grams``: of the windows, with ``factor`` the identity; ``windows``: for the knots; ``time``:
    correlation time [s]."""
    if device == "cpu" or not all(gram.latents for gram in grams):
        return parallel_map(lambda w: correlated(grams[w], windows[w], time), range(len(grams)))
    factors, widths = (
        [knot_factor(window, time) for window in windows],
        [gram.cross.shape[1] for gram in grams],
    )
    channels, size = len(grams[0].count), max(widths)
    places, values = [], []
    for w, (gram, factor) in enumerate(zip(grams, factors)):
        knots = np.arange(gram.nuisances, gram.nuisances + gram.latents).reshape(-1, len(factor))
        places.append(((w * size + knots[:, :, None]) * size + knots[:, None]).ravel())
        values.append(np.broadcast_to(factor, (len(knots), *factor.shape)).ravel())
    right = torch.eye(size, dtype=torch.float64, device=device).repeat(len(grams), 1, 1)
    where, what = (torch.from_numpy(np.concatenate(parts)).to(device) for parts in (places, values))
    right.view(-1)[where] = what
    right = right[:, None]
    inner = padded(
        [gram.placed for gram in grams], lambda factor, _: factor, (channels, size, size), device
    )
    products = _on_both(right.mT @ inner @ right, widths)
    return [
        correlated_with(gram, product.of, factor, product)
        for gram, product, factor in zip(grams, products, factors)
    ]


def left_by(
    windows: Sequence[Window],
    floors: np.ndarray,
    channels: int,
    fits: Sequence[np.ndarray],
    device: str,
) -> list[np.ndarray]:
    """Return windows' residuals after fits of initial states and latent forces.

    ``floors``: of the effects, shape (K,); ``fits``: of each window, its initial state in prior
    deviations and its latents at the knots, shape (D + L,). Returns for each window, shape (N,).
    """
    if device == "cpu":
        return parallel_map(lambda pair: left_of(*pair), zip(windows, fits))
    return _designed(windows, floors, channels, device).left([w.residual for w in windows], fits)


def with_residuals(
    grams: Sequence[Gram],
    windows: Sequence[Window],
    floors: np.ndarray,
    residuals: Sequence[np.ndarray],
    device: str,
) -> list[Gram]:
    """Grams with the same derivatives and other residuals: of all windows at once on a GPU, where
    the derivatives stay.

    ``grams``: of the windows; ``floors``: of the effects, shape (K,); ``residuals``: of each
    window, shape (N,)."""
    if device == "cpu" or _correlated(windows):
        return parallel_map(
            lambda w: with_residual(grams[w], windows[w], floors, residuals[w]), range(len(grams))
        )
    design = _designed(windows, floors, len(grams[0].count), device)
    return [
        with_products(gram, *products) for gram, products in zip(grams, design.products(residuals))
    ]
