"""Python's collection of cyclic garbage, paused while numba compiles a kernel of this package.

Numba makes millions of small objects that live until the kernel is done; to search them again and
again for garbage takes an eighth of the time.
"""

import gc

from numba.core import event


class PausedCollection(event.Listener):
    """Pauses the collection from the outermost kernel that is compiled to its end.

    Attributes
    ----------
    depth : int
        Number of kernels that are being compiled, each called by the one before.
    """

    def __init__(self):
        self.depth = 0
        self._paused = False

    def on_start(self, event):
        """Pause, if this is the outermost kernel and the collection is on."""
        kernel = (
            event.data["dispatcher"].py_func.__module__ or ""
        )  # none where made by exec
        if self.depth == 0 and not kernel.startswith("bfsensor._kernels"):
            return
        if self.depth == 0:
            self._paused = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event):
        """Go on, if this was the outermost kernel."""
        if self.depth == 0:
            return
        self.depth -= 1
        if self.depth == 0 and self._paused:
            gc.enable()


event.register("numba:compile", PausedCollection())
