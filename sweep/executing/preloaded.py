"""Imports what every worker needs, once, in the process that workers are forked from.  None of it starts a thread."""

import gc

from linksweep.sweep.executing.uncollected import uncollected

with uncollected():
    import distributed  # noqa: F401

    import linksweep.sweep.executing.worker_plugin  # noqa: F401

gc.freeze()  # workers will not search these objects either: they share this memory until one of them writes to it
