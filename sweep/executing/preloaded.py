"""What every worker imports, imported once in the process that they are forked from.  None of it starts a thread."""

import gc

from sweep.executing.uncollected import uncollected

with uncollected():
    import distributed  # noqa: F401

    import sweep.executing.worker_plugin  # noqa: F401

gc.freeze()  # nor will workers look there: they share this memory for as long as none of them touches it
