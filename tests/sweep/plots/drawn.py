"""The numbers that a panel shows, to be compared with those of a dataset."""

import numpy as np
from matplotlib.container import ErrorbarContainer
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse


def drawn(axes):
    """Every array of a panel: of lines and dots, bars, half the error bars and bands, and half the size of ellipses."""
    for one in axes.containers:
        for bars in one.lines[2] if isinstance(one, ErrorbarContainer) else ():
            yield [np.ptp(ends, axis=0).max() / 2.0 for ends in bars.get_segments() if len(ends)]
    yield [bar.get_width() for bar in axes.patches if bar.get_width()]
    for one in (one for one in axes.patches if isinstance(one, Ellipse)):
        sides, turn = np.array([one.get_width(), one.get_height()]) / 2.0, np.radians(one.get_angle())
        yield np.hypot(*(sides * [[np.cos(turn), np.sin(turn)], [np.sin(turn), -np.cos(turn)]]).T)
    for one in (*axes.lines, *axes.collections):
        yield from one.get_data() if isinstance(one, Line2D) else np.transpose(one.get_offsets())
        places = np.concatenate([np.zeros((0, 2)), *(path.vertices for path in getattr(one, "get_paths", list)())])
        x, y = places[np.isfinite(places).all(axis=1)].T
        yield [np.ptp(y[x == one]) / 2.0 for one in np.unique(x)]


def assert_shown(axes, wanted):
    """Each array of values is there, in the unit of the panel; NaN is where nothing is drawn."""
    factor = 1000.0 if "µ" in axes.get_xlabel() + axes.get_ylabel() else 1.0
    there = [np.asarray(one, dtype=float) for one in drawn(axes)]
    for values in (factor * np.asarray(one, dtype=float) for one in wanted):
        alike = (one for one in there if one.shape == values.shape)
        assert any(np.allclose(one, values, rtol=1e-6, equal_nan=True) for one in alike), (axes.get_ylabel(), values)
