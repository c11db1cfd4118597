"""Do images and clouds find partners, and if not, why?"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from calib_ros.config import OnlineConfig
from calib_ros.config.options import bounds
from calib_ros.frame import NANOSECONDS
from calib_ros.online.pairing.synchronizer import Synchronizer, SynchronizerCounts
from calib_ros.stamps import pair_tolerance, time_scales

WINDOW = 11  # checks, at one a second: what happened in 10 s
# Of the slower stream, from which share without partner on it is a problem: some messages get lost on most vehicles, and two of
# the least number may still wait.
UNPAIRED_SHARE, MIN_MESSAGES = 0.3, 10
MISSING_SHARE = 0.1  # of a stream's messages, from which on their loss is named
OTHER_CLOCK_S = 1.0  # between the newest stamps of both streams; drivers deliver within half a second
SILENT_PERIODS = 2.5  # without a message: one may be lost, and another one late


class PairingHealth:
    """Watches a synchronizer; `check` is to be called about once a second. Not thread-safe."""

    def __init__(self, synchronizer: Synchronizer) -> None:
        self._synchronizer = synchronizer
        self._counts: deque[SynchronizerCounts] = deque(maxlen=WINDOW)

    def check(self) -> str:
        """One line for a person if a large share of the slower stream has found no partner in the last 10 s, with the cause and
        what to do; else ''. At twice the rate every second message of the faster stream has none: that is no problem."""
        now = replace(self._synchronizer.counts)
        self._counts.append(now)
        before = self._counts[0]
        images, clouds, pairs = now.images - before.images, now.clouds - before.clouds, now.pairs - before.pairs
        fewer = min(images, clouds)
        if fewer < MIN_MESSAGES or now.jumps_back > before.jumps_back or pairs >= (1 - UNPAIRED_SHARE) * fewer:
            return ""
        of = "images" if images <= clouds else "clouds"
        return f"{1 - pairs / fewer:.0%} of the {of} find no partner: {self.cause()}"

    @property
    def waiting(self) -> bool:
        """True if an image and a cloud near enough for a pair wait for what comes next."""
        gap = self._synchronizer.nearest_gap_s()
        return gap is not None and gap <= self._synchronizer.tolerance / NANOSECONDS

    def describe(self) -> dict[str, str]:
        """By which rule messages are paired at present, for diagnostics: name -> value."""
        synchronizer = self._synchronizer
        offset, images, clouds = synchronizer.cloud_offset, *synchronizer.missing_shares()
        return {
            "largest difference of a pair, ms": f"{synchronizer.tolerance / 1e6:.0f}",
            "from a cloud's stamp to its sweep of the view, ms": "unknown" if offset is None else f"{offset / 1e6:.0f}",
            "missing between those that came": f"{images:.0%} of the images, {clouds:.0%} of the clouds",
        }

    def cause(self) -> str:
        """Why images and clouds do not belong together, and what to do."""
        synchronizer = self._synchronizer
        lead, gap, tolerance = synchronizer.lead_s(), synchronizer.nearest_gap_s(), synchronizer.tolerance / NANOSECONDS
        if lead is not None and abs(lead) >= OTHER_CLOCK_S:
            scale = time_scales(lead)
            cause = f"{scale[1]} are so far apart" if scale else "another clock, or that much delay"
            return (
                f"the newest image is stamped {_time(abs(lead))} {'after' if lead > 0 else 'before'} the newest cloud: {cause}; "
                "synchronise the clocks (PTP, chrony)"
            )
        alone, periods = synchronizer.alone_s(), synchronizer.periods
        stopped, period = ("clouds", periods[1]) if alone > 0 else ("images", periods[0])
        if abs(alone) >= max(OTHER_CLOCK_S, SILENT_PERIODS * period / NANOSECONDS):
            return f"no {stopped} have come for {_time(abs(alone))}; see that their driver runs and their messages get through"
        shares = dict(zip(("images", "clouds"), synchronizer.missing_shares(), strict=True))
        lost = [f"{share:.0%} of the {name}" for name, share in shares.items() if share >= MISSING_SHARE]
        if lost:
            return f"{' and '.join(lost)} are missing between those that came; see that the drivers send them and none get lost"
        if synchronizer.outruns_queue():
            return "one stream comes later than the queue of the other one holds; lower the rate of the faster one"
        every = " and ".join(f"{period / NANOSECONDS:.3g} s" if period else "an unknown time" for period in periods)
        if gap is None or gap <= tolerance:
            return f"images and clouds come every {every}, at irregular times; check both drivers' rates and stamps"
        widest = pair_tolerance(periods, bounds(OnlineConfig, "pair_tolerance_s")[1]) / NANOSECONDS
        cures = ["trigger the camera by the scanner", "synchronise the clocks"]
        cures += ["raise online.pair_tolerance_s"] if gap <= widest else []
        return (
            f"their stamps are {gap:.3f} s apart and more, {tolerance:.3g} s are allowed (images and clouds every {every}); "
            f"{', '.join(cures[:-1])} or {cures[-1]}"
        )


def _time(seconds: float) -> str:
    """A duration for people: 2.5 s, 3.0 h, 19700 days."""
    for unit, length, least in (("days", 86400.0, 2 * 86400.0), ("h", 3600.0, 7200.0)):
        if seconds >= least:
            return f"{seconds / length:.5g} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
