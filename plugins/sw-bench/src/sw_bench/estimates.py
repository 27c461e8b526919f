"""Estimates of how long processes take, from those that ended, or from a probe."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence

from sw_bench.cells import Job


class Estimates:
    """Seconds of a process by its label and scene, from the nearest that is known.

    known   (label, scene, seconds)
    """

    def __init__(self, known: Iterable[tuple[str, str, float]] = ()) -> None:
        self._pairs: dict[tuple[str, str], list[float]] = {}
        for label, scene, seconds in known:
            self.learn(label, scene, seconds)

    def learn(self, label: str, scene: str, seconds: float) -> None:
        """Take in one process."""
        self._pairs.setdefault((label, scene), []).append(seconds)

    def knows(self, label: str, scene: str) -> bool:
        """Whether such a process has been measured."""
        return (label, scene) in self._pairs

    def one(self, label: str, scene: str) -> float | None:
        """Return the seconds on that scene, else on others as scenes differ for other methods; None: unknown."""
        if (label, scene) in self._pairs:
            return statistics.fmean(self._pairs[label, scene])
        mine = {s: statistics.fmean(x) for (name, s), x in self._pairs.items() if name == label}
        if not mine:
            return None
        factors = []
        for (name, other), seconds in self._pairs.items():
            for known, own in mine.items():
                if other == scene and (name, known) in self._pairs and own > 0:
                    factors.append(own * statistics.fmean(seconds) / statistics.fmean(self._pairs[name, known]))
        return statistics.fmean(factors or mine.values())

    def of(self, job: Job) -> float | None:
        """Return the seconds of a process; None: nothing like it is known."""
        return self.one(*job.about)

    def left(self, waiting: Sequence[Job], running: Sequence[tuple[Job, float]], slots: int) -> float | None:
        """Return the seconds until all is done on so many places; None while too little is known.

        running     (job, seconds that it has run)
        """
        known = [(job, self.of(job)) for job in waiting]
        usual = [seconds for _, seconds in known if seconds is not None]
        going = [(self.of(job), since) for job, since in running]
        usual += [seconds for seconds, _ in going if seconds is not None]
        if not usual:
            return None
        mean = statistics.fmean(usual)
        ahead = [mean if seconds is None else seconds for _, seconds in known]
        rest = [max((mean if seconds is None else seconds) - since, 0.0) for seconds, since in going]
        return max((sum(ahead) + sum(rest)) / max(1, slots), max([*ahead, *rest], default=0.0))
