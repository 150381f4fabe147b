"""A notice on the log when numba begins to compile a kernel, so that nobody waits in silence."""

import logging
import multiprocessing

from numba.core import event

# CPU seconds on one core of 2.6 GHz, by a first image and a first table, cache empty:
# a sensor's 16 s, a table's 5 + 4 s.
TEXT = (
    "compiling kernels, which happens once: about 17 s for a first image, 10 s for a first "
    "table; `bfsensor warm` does it ahead of use"
)
"""Text of the notice."""


class CompilationNotice(event.Listener):
    """Logs :data:`TEXT` when the first kernel of this process is compiled.

    Numba raises the event only where no compiled code is found on disk, for these types and
    this processor, so that a warm start costs nothing.

    Attributes
    ----------
    given : bool
        Whether the notice was logged; set to True beforehand, it is never logged.
    """

    def __init__(self):
        self.given = False

    def on_start(self, event):
        """Log the notice unless it was logged, or this is a worker whose parent process logs it."""
        kernel = (
            event.data["dispatcher"].py_func.__module__ or ""
        )  # none where made by exec
        if self.given or not kernel.startswith("bfsensor._kernels"):
            return
        self.given = True
        if multiprocessing.parent_process() is None:
            logging.getLogger("bfsensor").warning(TEXT)

    def on_end(self, event):
        """Do nothing when a kernel is finished; numba's interface asks for this method."""


notice = CompilationNotice()
event.register("numba:compile", notice)
