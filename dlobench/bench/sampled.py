"""Scores samples of the future against true ones. Pure functions of arrays; padding never counts.

Shapes: samples (S, B, 32, 2) m, true (M, B, 32, 2) m, mask (32,). M = 1 is one truth; more are re-executions of the
same pushes, and every score is the mean over them. What a score subtracts for the spread of the samples is its unbiased
estimate, so that scores are *fair*: their expectation does not depend on S (Ferro 2014, "Fair scores for ensemble
forecasts"). For S = 1 that spread is defined as 0, and the score is the error of a point prediction. Fair scores may
be negative. All raise `UsageError` for other shapes, no sample, no truth, no query or no valid segment.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dlobench.bench.metrics import Array, Score, valid_segments
from dlobench.domain import MAX_SEGMENTS
from dlobench.errors import UsageError
from dlobench.trajectories import Floats, Mask

BANDWIDTHS = (0.0003, 0.001, 0.003, 0.01)  # m, of the kernel of MMD²: fixed, so that no data and no model moves them


def energy(samples: Floats, true: Floats, mask: Mask) -> float:
    """Returns the fair energy score of whole shapes, m, the mean over queries and true samples.

    E‖X − Y‖ − ½ E‖X − X'‖ with ‖x‖² the mean over valid segments of their squared Euclidean length: the Euclidean norm
    of all coordinates over the root of the number of segments, so that DLOs of all lengths compare, in metres. It is
    strictly proper for the joint distribution of all segments (Gneiting & Raftery 2007, section 4.3). For S = 1 it
    is `metrics.shape_error`.

    Examples:
        >>> mask, true = np.arange(32) < 20, np.zeros((1, 1, 32, 2), np.float32)  # one execution, of one query
        >>> sure = true + 0.005  # one sample, 7 mm off
        >>> unsure = np.concatenate([true - 0.005, true + 0.005])  # two, on both sides
        >>> print(f"{energy(sure, true, mask):.4f} {energy(unsure, true, mask):.4f}")
        0.0071 0.0000

    """
    scores = []
    for x, y in _queries(samples, true, mask):
        scores.append(_between(x, y).mean() - _within(x).sum() / max(len(x) * (len(x) - 1), 1))
    return float(np.mean(scores))


def segment_energy(samples: Floats, true: Floats, mask: Mask) -> float:
    """Returns the fair energy score of single segments in the plane, m, the mean over them, queries and true samples.

    The norm of a shape is the mean length of its segments: for S = 1 it is just `metrics.euclidean`. Proper, but
    blind to how segments move together; `energy` sees that.
    """
    scores = []
    for x, y in _queries(samples, true, mask):
        for k in range(0, x.shape[1], 2):
            a, b = x[:, k : k + 2], y[:, k : k + 2]
            scores.append(_between(a, b).mean() - _within(a).sum() / max(len(a) * (len(a) - 1), 1))
    return float(np.mean(scores))


def variogram(samples: Floats, true: Floats, mask: Mask) -> float:
    """Returns the fair variogram score of order ½, m: how wrong the differences between segments are.

    The mean over pairs of segments i < j and both axes of (E|Xᵢ − Xⱼ|^½ − |yᵢ − yⱼ|^½)², less the variance of the
    estimated expectation (Scheuerer & Hamill 2015, all weights alike; never across axes). Blind to what moves a whole
    shape, and not invariant to turning the frame. The estimator "fair" of `scoringrules`, without its S² differences
    of all pairs in memory. Raises `UsageError` for a single valid segment.
    """
    if int(np.count_nonzero(mask)) == 1:
        raise UsageError("a single valid segment has no variogram: at least two are needed")
    scores = []
    for x, y in _queries(samples, true, mask):
        estimated, observed = _variograms(x), _variograms(y)
        expected = estimated.mean(axis=-1, keepdims=True)
        noise = np.square(estimated - expected).sum() / max(len(x) * (len(x) - 1), 1) / expected.size
        scores.append(np.square(expected - observed).mean() - noise)
    return float(np.mean(scores))


def crps(samples: Floats, true: Floats, mask: Mask) -> float:
    """Returns the fair continuous ranked probability score, m, the mean over coordinates, queries and true samples.

    By `scoringrules`, whose estimator "pwm" is the fair one in time S log S (Zamo & Naveau 2018), on NumPy wherever it
    runs. For S = 1 it is the mean absolute error of a coordinate.
    """
    from scoringrules import crps_ensemble

    scores = []
    for x, y in _queries(samples, true, mask):
        if len(x) == 1:
            scores.append(np.abs(x - y).mean())
        else:
            ordered = np.broadcast_to(np.sort(x.T, axis=-1), (*y.shape, len(x)))
            scores.append(crps_ensemble(y, ordered, estimator="pwm", sorted_ensemble=True, backend="numpy").mean())
    return float(np.mean(scores))


def mmd2(samples: Floats, true: Floats, mask: Mask) -> float:
    """Returns the unbiased squared maximum mean discrepancy of whole shapes, the mean over queries; no unit.

    E k(X, X') + E k(Y, Y') − 2 E k(X, Y) over pairs of different samples (Gretton et al. 2012, eq. 3), with k the mean
    of four Gaussians exp(−d² / 2h²) of the distance d of whole shapes (that of `energy`), h = 0.3, 1, 3 and 10 mm: from
    below the noise of a push (0.5 mm) to about its length, the same for every model, domain and query. Its expectation
    is 0 for the true distribution, and above for any other. Raises `UsageError` unless S ≥ 2 and M ≥ 2.
    """
    S, M = len(samples), len(true)
    if S < 2 or M < 2:
        raise UsageError(f"MMD² of {S} samples and {M} true ones is undefined: at least two of each are needed")
    scores = []
    for x, y in _queries(samples, true, mask):
        alike = _kernel(_within(x)).mean() + _kernel(_within(y)).mean()
        scores.append(alike - 2 * _kernel(_between(x, y)).mean())
    return float(np.mean(scores))


def floor(score: Score, true: Floats, mask: Mask) -> float:
    """Returns what the oracle scores, which samples the truth itself: no model is better in expectation.

    True samples (R, B, 32, 2) are cut into halves; each half is scored against the other, so that no sample is scored
    against itself, and the mean is returned. A model scored against all R meets just the same truths; fair scores
    allow it any S. Raises `UsageError` unless R is even and at least 4.
    """
    R = len(true)
    if R < 4 or R % 2:
        raise UsageError(f"{R} true samples cannot be cut into halves that score each other: an even number from 4 can")
    one, other = true[: R // 2], true[R // 2 :]
    return (score(one, other, mask) + score(other, one, mask)) / 2


def check(samples: Floats, true: Floats, mask: Mask) -> None:
    """Raises `UsageError` unless these are S ≥ 1 samples and M ≥ 1 true ones of the same B ≥ 1 queries, and a mask."""
    valid_segments(mask)
    same = samples.ndim == true.ndim == 4 and samples.shape[1:] == true.shape[1:]
    if not same or true.shape[2:] != (MAX_SEGMENTS, 2) or 0 in samples.shape or 0 in true.shape:
        raise UsageError(
            f"samples of {samples.shape} cannot be scored against true ones of {true.shape}: "
            f"(S, B, {MAX_SEGMENTS}, 2) against (M, B, {MAX_SEGMENTS}, 2) with S, B and M ≥ 1 can"
        )


def _queries(samples: Floats, true: Floats, mask: Mask) -> Iterator[tuple[Array, Array]]:
    """Yields the samples (S, D) and the true ones (M, D) of each query, m: x and y of the valid segments in turn."""
    check(samples, true, mask)
    valid = valid_segments(mask)
    for b in range(samples.shape[1]):
        x, y = (each[:, b][:, valid].astype(np.float64) for each in (samples, true))
        yield x.reshape(len(x), -1), y.reshape(len(y), -1)


def _between(x: Array, y: Array) -> Array:
    """Returns the distances of every shape of x to every shape of y, m: root mean squares over segments."""
    from scipy.spatial.distance import cdist

    distances: Array = cdist(x, y) / np.sqrt(x.shape[1] / 2)
    return distances


def _within(x: Array) -> Array:
    """Returns the distances of every pair of different shapes, m, each pair once; none for a single shape."""
    from scipy.spatial.distance import pdist

    distances: Array = pdist(x) / np.sqrt(x.shape[1] / 2)
    return distances


def _variograms(x: Array) -> Array:
    """Returns |xᵢ − xⱼ|^½ of the coordinates of every pair of segments, (pairs, 2, S) m^½."""
    coordinates = np.ascontiguousarray(x.T).reshape(-1, 2, len(x))
    i, j = np.triu_indices(len(coordinates), k=1)
    difference = coordinates[i] - coordinates[j]
    return np.sqrt(np.abs(difference, out=difference), out=difference)


def _kernel(distance: Array) -> Array:
    """Returns the mean of Gaussian kernels of all bandwidths."""
    kernel: Array = np.mean([np.exp(-(distance**2) / (2 * h**2)) for h in BANDWIDTHS], axis=0)
    return kernel
