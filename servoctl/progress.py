"""Progress bars, which appear where work takes long."""

import sys
import time

PATIENCE = 1.0  # s before a bar appears


def progress_bar(name, wanted, total=None, **options):
    """A bar of tqdm, with its options, that appears after a second; `wanted` None means on a terminal."""
    from tqdm import tqdm

    return tqdm(desc=name, total=total, disable=not _shown(wanted), **{"delay": PATIENCE, **options})


class Progress:
    """Progress over a span [s], as a bar or as calls of a function of time; `wanted` None means a bar on a terminal."""

    def __init__(self, span, wanted):
        self.t0, self.total = span[0], abs(span[1] - span[0])
        self.call = wanted if callable(wanted) else None
        self.wanted = _shown(wanted)
        self.since, self.bar, self.done = time.monotonic(), None, 0.0

    def __call__(self, t):
        """Show that t [s] is reached."""
        if self.call is not None:
            self.call(t)
        elif self.wanted and (self.bar is not None or time.monotonic() - self.since >= PATIENCE):
            if self.bar is None:  # tqdm is not imported before: most simulations end sooner
                form = "{l_bar}{bar}| {n:.3g}/{total:.3g} s"
                self.bar = progress_bar("simulate", True, self.total, delay=0, unit="s", bar_format=form)
            self.bar.update(abs(t - self.t0) - self.done)
            self.done = abs(t - self.t0)

    def close(self):
        """Remove the bar."""
        if self.bar is not None:
            self.bar.close()


def _shown(wanted):
    return sys.stderr.isatty() if wanted is None else wanted
