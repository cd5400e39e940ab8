"""Makes the tables dr4-gaia, dr4-vlbi and dr4-epochs in sweeps/data: eight stars as Gaia DR4 will have them.

Two of them accelerate.  The frame of the satellite is turned by `EPSILON` at 2017.5 and spins with `OMEGA`.  Run it in
the folder of the repository: ``python docs/make_dr4.py``.
"""

from pathlib import Path

import numpy as np
from astropy.table import Table

from linksweep.core.frames import DEGREE, MAS, satellite_catalogue
from linksweep.core.tie.astrometry import PAIRS, bends, parallax_factors, propagated

FOLDER = Path(__file__).parent.parent / "sweeps" / "data"
EPOCH, YEAR_NS = 2017.5, 3.15576e16
EPSILON, OMEGA = np.array([0.40, -0.30, 0.50]) * MAS, np.array([-0.05, 0.06, 0.04]) * MAS
N, TRANSITS, CCDS, VLBI = 8, 20, 5, 4
NAMES = ("ra", "dec", "parallax", "pmra", "pmdec")
META = {"source": "made by docs/make_dr4.py of linksweep: simulated stars in the form of Gaia DR4"}


def main() -> None:
    rng = np.random.default_rng(5)
    ids = 1001 + np.arange(N)
    ra, dec = rng.uniform(0.0, 2.0 * np.pi, N), np.arcsin(rng.uniform(-0.9, 0.9, N))
    values = np.array([ra, dec, rng.uniform(3.0, 15.0, N) * MAS, *rng.normal(0.0, 30.0 * MAS, (2, N))])
    accelerations = np.zeros((N, 5))
    accelerations[[2, 5], :2] = np.array([[0.06, -0.05], [-0.05, 0.07]]) * MAS
    seen = np.array(satellite_catalogue(values[0], values[1], values[3], values[4], EPSILON, OMEGA))
    seen = np.array([seen[0], seen[1], values[2], seen[2], seen[3]])
    scans, rows = [], []
    for s in range(N):
        years = np.sort(rng.uniform(2014.7, 2019.9, TRANSITS)) - EPOCH
        angle = rng.uniform(-180.0, 180.0, TRANSITS)
        there = np.repeat(seen[:2, [s]], TRANSITS, axis=1)
        east, north = parallax_factors(*there, EPOCH + years)
        factor = np.float32(east * np.sin(angle * DEGREE) + north * np.cos(angle * DEGREE))
        delay = np.float32(rng.uniform(-4.5e11, 4.5e11, TRANSITS))
        times = ((EPOCH - 2010.0 + years[:, None]) * YEAR_NS + 4.86e9 * np.arange(CCDS)).astype(np.int64)
        t = (times + np.float64(delay[:, None])) / YEAR_NS + 2010.0 - EPOCH
        angles = np.repeat(np.round(angle, 4)[:, None], CCDS, axis=1)
        sine, cosine = np.sin(angles * DEGREE), np.cos(angles * DEGREE)
        design = np.stack([sine, cosine, np.repeat(factor[:, None], CCDS, axis=1), sine * t, cosine * t], axis=-1)
        bend = np.einsum("nik,k->ni", bends(t.ravel())[:, :2], accelerations[s]).reshape(*t.shape, 2) / MAS
        errors = np.round(rng.uniform(0.1, 0.3, t.shape), 3)
        w = design @ np.array([0.0, 0.0, *seen[2:, s]]) / MAS + sine * bend[..., 0] + cosine * bend[..., 1]
        w = np.round(w + errors * rng.normal(size=t.shape), 4)
        a, y = (design / errors[..., None]).reshape(-1, 5), (w / errors).ravel()
        covariance = np.linalg.inv(a.T @ a)
        rows.append((covariance @ a.T @ y, covariance))
        for k in range(TRANSITS):
            position = (seen[0, s] / DEGREE, seen[1, s] / DEGREE)
            along = (times[k], angles[k], w[k], errors[k], np.ones(CCDS, dtype=bool))
            scans.append((ids[s], 10 * len(scans) + 7, *position, delay[k], factor[k], 0.0, 0.0, *along))
    columns = (
        "source_id transit_id ra0 dec0 obs_time_bary_corr parallax_factor_al colour_factor_al agis_source_excess_noise"
    )
    arrays = "obs_time_tcb scan_pos_angle centroid_pos_al centroid_pos_error_al used_by_agis_al"
    epochs = Table(rows=scans, names=f"{columns} {arrays}".split(), meta=META)
    units = {"ra0": "deg", "dec0": "deg", "obs_time_bary_corr": "ns", "obs_time_tcb": "ns", "scan_pos_angle": "deg"}
    for name, unit in (units | {"centroid_pos_al": "mas", "centroid_pos_error_al": "mas"}).items():
        epochs[name].unit = unit
    epochs.write(FOLDER / "dr4-epochs.ecsv", overwrite=True)
    gaia(ids, seen, rows).write(FOLDER / "dr4-gaia.ecsv", overwrite=True)
    vlbi(rng, ids, values, accelerations).write(FOLDER / "dr4-vlbi.ecsv", overwrite=True)


def gaia(ids, seen, rows):
    """Return the rows of gaia_source, or of all_source_astrometry: single stars."""
    table = Table({"source_id": ids, "ref_epoch": np.full(N, EPOCH)}, meta=META)
    result, sigma = np.array([row[0] for row in rows]).T, np.sqrt([np.diag(row[1]) for row in rows]).T
    for i, name in enumerate(NAMES):
        table[name] = np.round(result[i], 6)
        table[f"{name}_error"] = np.round(sigma[i], 6)
    table["ra"] = (seen[0] + result[0] * MAS / np.cos(seen[1])) / DEGREE
    table["dec"] = (seen[1] + result[1] * MAS) / DEGREE
    for i, j in PAIRS:
        correlation = [row[1][i, j] / (sigma[i, s] * sigma[j, s]) for s, row in enumerate(rows)]
        table[f"{NAMES[i]}_{NAMES[j]}_corr"] = np.round(correlation, 6)
    for name in NAMES:
        table[name].unit = {"ra": "deg", "dec": "deg", "parallax": "mas"}.get(name, "mas / yr")
        table[f"{name}_error"].unit = "mas / yr" if name.startswith("pm") else "mas"
    return table


def vlbi(rng, ids, values, accelerations):
    """Return positions of single epochs."""
    table = Table(
        names=("source_id", "ref_epoch", *NAMES[:2], "ra_error", "dec_error"), dtype=("i8", *["f8"] * 5), meta=META
    )
    for s in range(N):
        for epoch in np.sort(np.round(rng.uniform(2009.0, 2026.0, VLBI), 3)):
            start, end = np.array([EPOCH]), np.array([epoch])
            there = propagated(values[:, [s]], None, start, end)[:, 0]
            step = parallax_factors(there[:1], there[1:2], end)[:, 0] * there[2]
            step += bends(end - start)[0, :2] @ accelerations[s]
            errors = np.round(rng.uniform(0.05, 0.15, 2), 3)
            step += errors * rng.normal(size=2) * MAS
            east, north = there[0] + step[0] / np.cos(there[1]), there[1] + step[1]
            table.add_row((ids[s], epoch, east / DEGREE, north / DEGREE, *errors))
    for name, unit in (("ra", "deg"), ("dec", "deg"), ("ra_error", "mas"), ("dec_error", "mas"), ("ref_epoch", "yr")):
        table[name].unit = unit
    return table


if __name__ == "__main__":
    main()
