"""How large a plan is, and how much of it is left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sweep.contract import Value
from sweep.planning.plan import MOST_SHARING, SHARED, PlanSize


@dataclass(frozen=True)
class Survey:
    """How large a plan is, as far as known, what of it the ledger holds, and what is pending; the rest has failed."""

    total: PlanSize
    held: PlanSize
    pending: PlanSize


def cost_together(groups: Mapping[tuple[Value, ...], Sequence[tuple[float, PlanSize]]]) -> float:
    """Return what is left of points, each with the cost of its realisations, that draw together with those of their
    group: the costliest draws, the others only make something of it (see `Plan.work`).
    """
    total = 0.0
    for members in groups.values():
        for start in range(0, len(members), MOST_SHARING):
            piece = members[start : start + MOST_SHARING]
            draws = max(range(len(piece)), key=lambda k: piece[k][0])
            for k, (cost, left) in enumerate(piece):
                total += left.cost - (0.0 if k == draws else (1.0 - SHARED) * cost * left.realisations)
    return total
