"""How long a measurement has been refused, when nobody knows any more whether it or the filter is wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

REFUSAL_GAP_S = 10.0  # without a refused one for longer, the refusals begin anew


@dataclass
class Refusals:
    """Measurements refused one after the other, none taken in between, for ``patience_s`` at most."""

    patience_s: float
    _since: float = -math.inf
    _latest: float = -math.inf

    def taken(self) -> None:
        """One was used."""
        self._latest = -math.inf

    @property
    def since(self) -> float:
        """When the first of them was [s]."""
        return self._since

    def too_long(self, t: float) -> bool:
        """Whether with this one, refused at ``t`` [s], patience is at its end."""
        if t - self._latest > REFUSAL_GAP_S:
            self._since = t
        self._latest = t
        return t - self._since >= self.patience_s
