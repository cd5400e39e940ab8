"""The tables that come with the package, by their names: icrf2, icrf3, psrpi ..."""

from importlib import resources
from pathlib import Path


def built_in_table(path: Path) -> Path | None:
    """Return the file of a built-in table, where its name is given and there is no such file."""
    if path.suffix or len(path.parts) != 1 or path.exists():
        return None
    folder = Path(str(resources.files("sweeps") / "data"))
    return next((file for file in sorted(folder.glob("*.ecsv*")) if file.name.split(".")[0] == path.name), None)
