"""Whether tie points show that a flight lies on a map, or only what any map would show by chance.

An a-contrario test (Desolneux, Moisan, Morel: From Gestalt Theory to Image Analysis, 2008; for fitted models AC-RANSAC,
Moisan and Stival 2004). On a map of other ground a tie point's best match lies anywhere in its search window, so the
number of those that agree with one shift by chance is binomial. The number of models tried times its tail is the
expected number of false matches. Ties that share ground are not independent; only one of a patch's size is counted.
"""

from typing import Final

import numpy as np
from scipy.special import bdtrc

from orthoswarm.model.arrays import Array, Ints

FALSE_MATCHES: Final = 1e-4
"""A flight is taken to lie on the map if a map of other ground would show an agreement as good as the one found so many
times only (expected number of false matches); measured by benchmarks/robustness/wrong_maps.py."""
_EVIDENCE_FEWEST: Final = 4  # fewest tie points of a leg or a flight: fewer agree with themselves alone
_EVIDENCE_PAIRS: Final = 400  # most lines through two tie points that are tried in a group (for its time)
_EVIDENCE_TOLERANCES_M: Final = (0.7, 1.5, 3.0)  # distances within which tie points agree on a place on the map


def false_matches_log10(
    ground: Array, shift: Array, order: Array, *, leg: Ints, reach_m: float, patch_m: float
) -> float:
    """Decimal logarithm of the expected number of false matches behind the best agreement of tie points.

    What is tried: one shift for all of them, and for each leg a line of shifts along it (drift of the receiver, error
    of heading), within each of the tolerances of the configuration.

    ground: float64 (Q, 2), where the ties are, metres. shift: float64 (Q, 2), from there to where the map shows them,
    before anything was fitted to them. order: float64 (Q,), number of the picture. leg: int32 (Q,), its leg, -1 between
    legs. reach_m: how far each was searched, to each side. patch_m: side of what was compared.
    """
    # the first tie of each cell of a patch's size
    cells = np.floor(ground / patch_m).astype(np.int64)
    alone = np.sort(np.unique(cells, axis=0, return_index=True)[1]) if len(ground) else np.zeros(0, np.intp)
    shift, order, leg = shift[alone], order[alone], leg[alone]
    groups = [(shift, np.zeros(len(shift)))]
    groups += [(shift[leg == k], order[leg == k]) for k in np.unique(leg[leg >= 0])]
    groups = [g for g in groups if len(g[0]) >= _EVIDENCE_FEWEST]
    best = min((_group(s, t, reach_m) for s, t in groups), default=0.0)
    return best + float(np.log10(max(len(groups), 1)))


def agreement_probability(agree: int, count: int, within_m: float, reach_m: float) -> float:
    """Probability that so many of `count` ties lie within a distance of their place by chance."""
    return _binomial_tail(agree, count, _share(within_m, reach_m))


def _group(shift: Array, along: Array, reach_m: float) -> float:
    """The evidence of one group by its best line through two ties, or by one tie's shift if all are at one place."""
    count = len(shift)
    if np.ptp(along) > 0:
        i, j = np.triu_indices(count, 1)
        apart = along[j] != along[i]
        i, j = i[apart], j[apart]
        step = -(-len(i) // _EVIDENCE_PAIRS)
        i, j = i[::step], j[::step]
        slope = (shift[j] - shift[i]) / (along[j] - along[i])[:, None]
        fixed = 2
    else:
        i, slope, fixed = np.arange(count), np.zeros((count, 2)), 1
    if not len(i):
        return 0.0
    model = shift[i][:, None] + slope[:, None] * (along[None] - along[i][:, None])[..., None]
    away = np.hypot(*np.moveaxis(shift[None] - model, -1, 0))
    best = 0.0
    for tolerance in _EVIDENCE_TOLERANCES_M:
        most = int((away < tolerance).sum(1).max())
        tail = _binomial_tail(most - fixed, count - fixed, _share(tolerance, reach_m))
        best = min(best, float(np.log10(tail)) + float(np.log10(len(i) * len(_EVIDENCE_TOLERANCES_M))))
    return best


def _binomial_tail(successes: int, trials: int, share: float) -> float:
    """Probability of at least so many successes, at least the smallest number, so that it has a logarithm.

    By the incomplete beta function: importing scipy.stats for it would take a third of a second.
    """
    return max(float(bdtrc(successes - 1, trials, share)), float(np.finfo(float).tiny)) if successes > 0 else 1.0


def _share(within_m: float, reach_m: float) -> float:
    """Share of a square search window that lies within a distance of one place."""
    return min(1.0, np.pi * within_m**2 / (2.0 * reach_m) ** 2)
