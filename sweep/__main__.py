"""The command ``sweep``; ``python -m linksweep`` is the same."""

import atexit
import gc
import signal
import warnings


def main() -> None:
    """Import the command and run it; Ctrl-C before it handles signals itself ends the process without a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not under nohup
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    warnings.filterwarnings("ignore", ".*multiple slashes")  # by astropy, of units that FITS does not like
    gc.disable()  # until the command begins: to search imports for garbage takes a tenth of a short run
    from linksweep.sweep import cli

    atexit.register(cli.leave_with_exit_code)  # what is registered first runs last
    cli.prepare_streams()
    try:
        cli.main(prog_name="sweep")
    except SystemExit as end:
        cli.EXIT_CODES.append(int(end.code or 0))
        raise


if __name__ == "__main__":
    main()
