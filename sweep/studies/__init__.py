"""Studies: what a file, a mapping or a function asks for, read and checked."""

from importlib import resources
from pathlib import Path


def built_in_studies() -> dict[str, Path]:
    """Return the studies that ship with the package, by name."""
    return {path.stem: path for path in sorted(Path(str(resources.files("linksweep") / "sweeps")).glob("*.toml"))}
