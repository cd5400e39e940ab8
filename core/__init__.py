"""The link of a satellite's proper-motion system to the extragalactic frame.

Conventions, the same in every module (a test checks each):

* Inside ``core`` angles are radians and proper motions rad/yr; a number in another unit has that unit
  in its name (``sigma_mas``, ``mission_length_yr``).  Vectors are ``(3, ...)`` and objects come last.
* ``pmra`` is mu_alpha* = (d alpha/dt) cos(dec), as in the Gaia archive.
* Differences are **reference - satellite**.  The orientation epsilon and the spin omega rotate the *vector*:
  ``r_ref = R r_sat`` and ``v_ref = R v_sat + omega x r_ref`` with ``R = exp([epsilon x])``.
* The four observables of an object are, in this order, ``(d alpha*, d dec, d pmra, d pmdec)``; the unknowns
  are ``(epsilon_x, epsilon_y, epsilon_z, omega_x, omega_y, omega_z)``.
* Every random number comes from a generator that the caller passes in.

Nothing here prints, logs, reads a clock, touches a file or imports dask, xarray, zarr or click.
"""
