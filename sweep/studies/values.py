"""Values of parameters, alone, along an axis and in a column, checked against the experiment."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from sweep.contract import Experiment, SweepError, Value, shown
from sweep.formatting import first_of
from sweep.studies.axes import axis_values
from sweep.studies.problems import Problems
from sweep.studies.source import Place
from sweep.tables.file import table_file


class Values:
    """Reads values of the parameters of an experiment; ``problems`` takes what is wrong.

    Files stand in ``folder``, or in the working directory where an option names them.
    """

    def __init__(self, experiment: Experiment, folder: Path, problems: Problems) -> None:
        self.experiment, self.problems = experiment, problems
        self._folder = folder

    def one(self, place: Place, name: str, raw: object, which: str = "") -> Value:
        """Return the value that stands at a place, None if it is wrong; problems begin with ``which``."""
        try:
            parameter = self.experiment.parameter(name)
            value = parameter.parse(raw)
            folder = Path.cwd() if place[:2] in self.problems.overridden else self._folder
            return table_file(folder / value) if parameter.kind == "file" else value
        except ValueError as error:
            self.problems.add(place, f"{which}{error}")
        except SweepError as error:
            self.problems.add(place, f"{shown(raw)}: {error}")
        return None

    def axis(self, name: str, spec: object) -> tuple[Value, ...] | None:
        """Return the values of an axis, a list or a range of them; None if any is wrong."""
        place = ("axes", name)
        with self.problems.at(place):
            parameter = self.experiment.parameter(name)
            if not parameter.may_be_axis:
                raise ValueError(f"a {parameter.kind} cannot be an axis")
            raw_values = axis_values(spec, whole=parameter.kind == "int")
            if not raw_values:
                self.problems.add(place, "an axis needs at least one value")
            values = self.several(place, name, raw_values)
            repeated = [shown(value) for value, n in Counter(values or ()).items() if n > 1]
            if repeated:
                self.problems.add(place, f"duplicate value{'s' if len(repeated) > 1 else ''} {first_of(repeated, 10)}")
            return values
        return None

    def several(
        self, place: Place, name: str, raw_values: Sequence[object], rows: bool = False
    ) -> tuple[Value, ...] | None:
        """Return values of one type, None if any is wrong; problems name the row, from 1, where they are ``rows``."""
        before = len(self.problems.found)
        values = []
        for number, raw in enumerate(raw_values, start=1):
            values.append(self.one(place, name, raw, f"row {number}: " if rows else ""))
            if len(self.problems.found) >= before + 5:
                self.problems.add(place, "... and perhaps more values like these")
                return None
        if len(self.problems.found) > before:
            return None
        if self.experiment.parameter(name).kind == "any":
            kinds = {type(value) for value in values}
            if kinds == {int, float}:
                values = [float(value) for value in values]
            elif len(kinds) > 1:
                named = ", ".join(sorted(kind.__name__ for kind in kinds))
                self.problems.add(place, f"has values of several types ({named}); an axis is of one")
                return None
        return tuple(values)
