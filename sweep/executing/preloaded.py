"""What every worker imports, imported once in the process that they are forked from.  None of it starts a thread."""

import gc

gc.disable()  # modules are no garbage, and looking for some takes a tenth of the time

import distributed  # noqa: E402, F401

import sweep.executing.worker_plugin  # noqa: E402, F401

gc.freeze()  # nor will they be: workers share this memory for as long as none of them touches it
gc.enable()
