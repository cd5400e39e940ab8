"""``python -m linksweep``: the command ``sweep``."""

from linksweep.sweep.__main__ import main

if __name__ == "__main__":
    main()
