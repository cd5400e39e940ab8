"""The command ``sweep``; ``python -m linksweep`` is the same."""

import atexit
import gc
import os
import signal
import sys
import warnings
from contextlib import suppress


def main() -> None:
    """Import the command and run it; Ctrl-C before it handles signals itself ends the process without a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not under nohup
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    warnings.filterwarnings("ignore", ".*multiple slashes")  # by astropy, of units that FITS does not like
    gc.disable()  # until the command begins: to search imports for garbage takes a tenth of a short run
    from linksweep.sweep import cli

    codes = list[int]()
    atexit.register(_leave, codes)  # what is registered first runs last
    cli.prepare_streams()
    try:
        cli.main(prog_name="sweep")
    except SystemExit as end:
        codes.append(int(end.code or 0))
        raise


def _leave(codes: list[int]) -> None:
    """End a process, after its clean-up, with the exit code of its command where something else would replace that.

    Python would end it by SIGINT if that interrupted code run by ``exec``, with which dataclasses are made; threads of
    pyarrow may abort it while their library is unloaded (apache/arrow issue 34314).
    """
    if codes and (codes[-1] > 128 or "pyarrow" in sys.modules):
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(codes[-1])


if __name__ == "__main__":
    main()
