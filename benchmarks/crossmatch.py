"""Time, memory, completeness and false matches of `sweep match` on made catalogues whose truth is known.

    python benchmarks/crossmatch.py                  2.5 million stars, 1 million galaxy entries
    python benchmarks/crossmatch.py --scale 0.01     a quick look
    python benchmarks/crossmatch.py --json           for a script

The made sky: stars crowd toward the Galactic plane, have Tycho-like errors, proper motions with long tails and epoch
1991.25; galaxies cluster, avoid the plane and stand in two catalogues, `wide` (90 % of them, 1 arcsec) and `sharp`
(27 %, 0.3 arcsec, 80 % with PGC number), some at a grossly wrong position.  A few galaxies were taken for stars by the
star catalogue or its supplement.  The search is a process of its own, from reading FITS to writing ECSV and map.
Exit code 1 if it takes more than 60 s or 4 GB.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from linksweep.core.catalogues import isotropic
from linksweep.core.frames import ARCSEC, DEGREE, GALACTIC_AXES, MAS, position
from linksweep.sweep.search.search import Positions, at_epoch

Array = NDArray[np.float64]

N_STARS, N_SUPPLEMENT, N_ENTRIES, N_COUNTERPARTS = 2_500_000, 17_600, 1_000_000, 3000
STAR_EPOCH, EPOCH = 1991.25, 2000.0
WIDE = {"share": 0.90, "sigma_arcsec": 1.0, "radius_arcsec": 4.0, "blunders": 0.03, "named": 1.0}
SHARP = {"share": 0.27, "sigma_arcsec": 0.3, "radius_arcsec": 1.5, "blunders": 0.01, "named": 0.8}
BLUNDER_ARCSEC = (20.0, 180.0)
MAX_SECONDS, MAX_GIGABYTES = 60.0, 4.0


def shifted(ra: Array, dec: Array, east: Array, north: Array) -> tuple[Array, Array]:
    """Return positions (rad) moved by small angles (rad)."""
    none = np.zeros_like(ra)
    moved = at_epoch(Positions(ra, dec, none, none), east, north, none, none, none + 1.0)
    return moved.ra, moved.dec


def star_sky(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Return ra, dec (rad): 40 % isotropic, 60 % toward the Galactic plane with an e-folding of 0.25 in sin b."""
    ra, dec = isotropic(rng, n)
    disc = rng.random(n) < 0.6
    sin_b = rng.laplace(0.0, 0.25, n)
    sin_b = np.where(np.abs(sin_b) < 1.0, sin_b, rng.uniform(-1.0, 1.0, n))
    longitude, cos_b = rng.uniform(0.0, 2.0 * np.pi, n), np.sqrt(1.0 - sin_b**2)
    galactic = np.stack([cos_b * np.cos(longitude), cos_b * np.sin(longitude), sin_b])
    disc_ra, disc_dec = position(GALACTIC_AXES.T @ galactic)
    return np.where(disc, disc_ra, ra), np.where(disc, disc_dec, dec)


def galaxy_sky(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Return ra, dec (rad): |b| > 8 deg, 40 % within about 0.3 deg of another one."""
    ra, dec = isotropic(rng, n, zone_of_avoidance=8.0 * DEGREE)
    member, centre = rng.random(n) < 0.4, rng.integers(0, max(n // 50, 1), n)
    near_ra, near_dec = shifted(
        ra[centre], dec[centre], rng.normal(0.0, 0.3 * DEGREE, n), rng.normal(0.0, 0.3 * DEGREE, n)
    )
    return np.where(member, near_ra, ra), np.where(member, near_dec, dec)


def star_table(rng: np.random.Generator, ra: Array, dec: Array, vt_mag: Array, moving: NDArray[np.bool_]) -> Table:
    """Return a star table at STAR_EPOCH; stars that move have proper motions, the others only errors of them."""
    n = len(ra)
    sigma = (7.0 + 113.0 * 10.0 ** (0.4 * (vt_mag - 12.5))) * MAS
    sigma_pm = np.full(n, 3.0 * MAS)
    pmra, pmdec = (np.where(moving, 8.0 * MAS * rng.standard_t(3, n), 0.0) for _ in "ad")
    none = np.zeros(n)
    there = at_epoch(Positions(ra, dec, none, none), pmra, pmdec, none, none, none + STAR_EPOCH - EPOCH)
    seen_ra, seen_dec = shifted(there.ra, there.dec, rng.normal(0.0, sigma), rng.normal(0.0, sigma))
    return Table(
        {
            "ra": seen_ra / DEGREE,
            "dec": seen_dec / DEGREE,
            "ra_error": sigma / MAS,
            "dec_error": sigma / MAS,
            "pmra": (pmra + rng.normal(0.0, sigma_pm)) / MAS,
            "pmdec": (pmdec + rng.normal(0.0, sigma_pm)) / MAS,
            "pmra_error": sigma_pm / MAS,
            "pmdec_error": sigma_pm / MAS,
            "vt_mag": vt_mag,
            "ref_epoch": np.full(n, STAR_EPOCH),
        }
    )


def galaxy_table(
    rng: np.random.Generator, ra: Array, dec: Array, catalogue: dict[str, float]
) -> tuple[Table, NDArray[np.int64], NDArray[np.bool_]]:
    """Return a galaxy catalogue, the galaxy of each entry, and which entries are blunders."""
    chosen = rng.permutation(len(ra))[: round(catalogue["share"] * len(ra))]
    n, sigma = len(chosen), catalogue["sigma_arcsec"] * ARCSEC
    blunder = rng.random(n) < catalogue["blunders"]
    how_far, direction = rng.uniform(*BLUNDER_ARCSEC, n) * ARCSEC * blunder, rng.uniform(0.0, 2.0 * np.pi, n)
    seen_ra, seen_dec = shifted(
        ra[chosen],
        dec[chosen],
        rng.normal(0.0, sigma, n) + how_far * np.sin(direction),
        rng.normal(0.0, sigma, n) + how_far * np.cos(direction),
    )
    named = rng.random(n) < catalogue["named"]
    table = Table({"ra": seen_ra / DEGREE, "dec": seen_dec / DEGREE, "PGC": np.where(named, chosen + 1, 0)})
    return table, chosen, blunder


def make(rng: np.random.Generator, scale: float, folder: Path) -> dict[str, Any]:
    """Write the catalogues as FITS; return the truth."""
    n_stars, n_supplement = round(N_STARS * scale), round(N_SUPPLEMENT * scale)
    n_counterparts = max(round(N_COUNTERPARTS * scale), 20)
    galaxy_ra, galaxy_dec = galaxy_sky(rng, round(N_ENTRIES * scale / (WIDE["share"] + SHARP["share"])))
    truth: dict[str, Any] = {}
    counterparts = rng.permutation(len(galaxy_ra))[:n_counterparts]
    in_supplement = rng.random(n_counterparts) < 0.15
    for name, n, mine in (
        ("stars", n_stars, counterparts[~in_supplement]),
        ("supplement", n_supplement, counterparts[in_supplement]),
    ):
        ra, dec = star_sky(rng, n - len(mine))
        core, direction = rng.exponential(0.3 * ARCSEC, len(mine)), rng.uniform(0.0, 2.0 * np.pi, len(mine))
        core_ra, core_dec = shifted(
            galaxy_ra[mine], galaxy_dec[mine], core * np.sin(direction), core * np.cos(direction)
        )
        order = rng.permutation(n)
        vt_mag = np.concatenate(
            [
                np.clip(12.5 + np.log10(1.0 - rng.random(n - len(mine))) / 0.5, 2.0, None),
                np.minimum(rng.normal(12.5, 0.4, len(mine)), 13.2),
            ]
        )
        table = star_table(
            rng,
            np.concatenate([ra, core_ra])[order],
            np.concatenate([dec, core_dec])[order],
            vt_mag[order],
            np.arange(n)[order] < len(ra),
        )
        number = np.arange(n) + (N_STARS if name == "supplement" else 0)
        table["TYC1"], table["TYC2"], table["TYC3"] = number // 1000 + 1, number % 1000 + 1, np.ones(n, dtype=int)
        table.write(folder / f"{name}.fits")
        truth[name] = np.concatenate([np.full(len(ra), -1), mine])[order]
    findable = np.zeros(len(galaxy_ra), dtype=bool)
    for name, catalogue in (("wide", WIDE), ("sharp", SHARP)):
        table, truth[name], blunder = galaxy_table(rng, galaxy_ra, galaxy_dec, catalogue)
        table.write(folder / f"{name}.fits")
        findable[truth[name][~blunder]] = True
    truth["counterparts"] = n_counterparts
    truth["in_a_catalogue_at_the_right_place"] = int(findable[counterparts].sum())
    return truth


def search(folder: Path) -> dict[str, Any]:
    """Run the search as a process; return its summary, wall time (s) and peak memory (GB)."""
    command = [sys.executable, "-c", "from linksweep.sweep.cli import main; main()", "match", "stars.fits", "wide.fits"]
    command += ["sharp.fits", "--supplement", "supplement.fits", "--json", "-o", "out.ecsv", "--figure", "out.png"]
    for name, catalogue in (("wide", WIDE), ("sharp", SHARP)):
        command += [
            "--radius",
            f"{name}={catalogue['radius_arcsec']}",
            "--error",
            f"{name}={catalogue['sigma_arcsec']}",
        ]
    started = time.perf_counter()
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        text = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - started
    if process.returncode:
        sys.exit(f"sweep match failed with exit code {process.returncode}")
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return {"seconds": seconds, "gigabytes": usage.ru_maxrss * unit / 1e9, "summary": json.loads(text)}


def judge(folder: Path, truth: dict[str, Any]) -> dict[str, Any]:
    """Return completeness and false-match rate of each class against the truth."""
    actual = Table.read(folder / "out.ecsv", format="ascii.ecsv")
    star = np.empty(len(actual), dtype=np.int64)
    galaxy = np.empty(len(actual), dtype=np.int64)
    for column, row, out in (("star_table", "star_row", star), ("galaxy_table", "galaxy_row", galaxy)):
        tables = np.asarray(actual[column])
        for name in np.unique(tables):
            mine = tables == name
            out[mine] = truth[str(name)][np.asarray(actual[row])[mine] - 1]
    right = star == galaxy
    classes = np.asarray(actual["class"])
    result = {
        name: {"matches": int(mine.sum()), "false": int((mine & ~right).sum())}
        for name in ("certain", "uncertain", "supplement", "all")
        for mine in [(classes == name) | (name == "all")]
    }
    for row_of in result.values():
        row_of["false_match_rate"] = row_of["false"] / max(row_of["matches"], 1)
    return {
        "classes": result,
        "completeness": int(right.sum()) / truth["counterparts"],
        "completeness_without_blunders": int(right.sum()) / truth["in_a_catalogue_at_the_right_place"],
        "counterparts_found_twice": len(actual) - len(np.unique(star[right])) - int((~right).sum()),
    }


def main() -> None:
    """Make the catalogues, search them, print what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0, help="factor on all numbers of objects")
    parser.add_argument("--seed", type=int, default=20031)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = make(np.random.default_rng(options.seed), options.scale, folder)
        run = search(folder)
        verdict = judge(folder, truth)
    summary = run.pop("summary")
    report = {
        "cores": os.cpu_count(),
        "seed": options.seed,
        "stars": summary["stars"],
        "entries": {key: row["entries"] for key, row in summary["catalogues"].items()},
        "counterparts": truth["counterparts"],
        **run,
        **verdict,
        "catalogues": summary["catalogues"],
        "mean_error_mas": summary["classes"]["all"]["ra_error_mas"],
    }
    if options.json:
        print(json.dumps(report, indent=1))
    else:
        for key, value in report.items():
            if isinstance(value, dict) and any(isinstance(v, dict) for v in value.values()):
                print(f"{key}:")
                for row_name, row in value.items():
                    print(f"  {row_name}: {_plain(row)}")
            else:
                print(f"{key}: {_plain(value)}")
    if run["seconds"] > MAX_SECONDS or run["gigabytes"] > MAX_GIGABYTES:
        sys.exit(1)


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(v)}" for key, v in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
