"""What counts tell: intervals of rates, and whether two methods differ on the same trials."""

from dataclasses import dataclass
from functools import cache


@dataclass(frozen=True)
class Rate:
    """So many successes in so many trials."""

    successes: int
    n: int

    @property
    def value(self) -> float | None:
        """The share of successes; None of no trial."""
        return self.successes / self.n if self.n else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The ends of its 95 % confidence interval (Wilson 1927); None of no trial."""
        return wilson(self.successes, self.n) if self.n else None


@cache  # a table asks for few different ones, and each takes scipy a third of a millisecond
def wilson(successes: int, n: int) -> tuple[float, float]:
    """Returns the 95 % confidence interval of a rate (Wilson 1927); ``n`` is at least 1."""
    from scipy.stats import binomtest  # slow to import

    interval = binomtest(successes, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


@cache
def mcnemar(only_first: int, only_second: int) -> float:
    """Returns the p-value of McNemar's exact test that two methods do equally well.

    Of the trials that both did alike nothing is told; of those that only one of them solved, each
    is as likely to be the one's as the other's, if they are equally good (McNemar 1947).

    Args:
        only_first: trials that the first method solved and the second did not.
        only_second: the other way round.
    """
    from scipy.stats import binomtest

    n = only_first + only_second
    return float(binomtest(only_first, n, 0.5).pvalue) if n else 1.0
