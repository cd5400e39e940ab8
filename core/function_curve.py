"""An accuracy curve that a user's function gives."""

from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array
from linksweep.sweep.contract import Function


class CurveError(ValueError):
    """A user's curve has no valid value at some magnitude."""


@dataclass(frozen=True)
class CurveOfFunction:
    """A function of an array of magnitudes, shape (N,), times ``factor``; it must depend on nothing else.

    Raises CurveError where it raises, or returns anything but positive finite numbers of the same shape.
    """

    function: Function
    factor: float = 1.0

    def __call__(self, v_mag: Array) -> Array:
        """Return the function's values."""
        name, shape = self.function.name, np.shape(v_mag)
        flat = np.array(v_mag, dtype=np.float64).reshape(-1)  # a copy: the user's function may change it
        try:
            with np.errstate(all="ignore"):  # the values are checked below
                returned = self.function(flat.copy())
                found = np.asarray(returned)
        except (Exception, SystemExit) as error:  # whatever a user's function raises
            raise CurveError(f"the function {name!r} raises {type(error).__name__}: {error}") from error
        if found.shape != flat.shape or found.dtype.kind not in "fiu":
            what = f"{found.dtype} of shape {found.shape}"
            raise CurveError(f"the function {name!r} returns {what}, not numbers of shape {flat.shape}")
        masked = np.count_nonzero(np.ma.getmaskarray(returned))
        if masked:
            raise CurveError(f"the function {name!r} returns {masked} masked values")
        bad = ~(np.isfinite(found) & (found > 0))
        if bad.any():
            first = int(np.argmax(bad))
            value, at = found[first], flat[first]
            raise CurveError(f"the function {name!r} returns {value:g} at V = {at:g} mag: must be positive and finite")
        return np.asarray(self.factor * found.astype(np.float64)).reshape(shape)

    def times(self, factor: float) -> "CurveOfFunction":
        """Return the curve times a factor."""
        return CurveOfFunction(self.function, factor * self.factor)
