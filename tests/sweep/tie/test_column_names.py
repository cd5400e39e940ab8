"""Names of columns as archives have them, in any case of letters."""

import numpy as np
from astropy.table import Table

from linksweep.core.tie.astrometry import PAIRS, kinds
from linksweep.sweep.tables.columns import first_found
from linksweep.sweep.tie.tables import read_table
from tests.core.tie.made import stars
from tests.sweep.tie.test_tables import gaia

VIZIER = ("RA", "DE", "Plx", "pmRA", "pmDE")


def test_the_own_case_of_letters_comes_first():
    assert first_found(["ra", "radeg"], ["RAdeg", "RA"]) == "RA"
    assert first_found(["ra"], ["RA", "ra"]) == "ra"
    assert first_found(["ra"], ["dec"]) is None


def test_columns_in_upper_case_are_the_same(tmp_path):
    made = stars(5)
    wanted = read_table(gaia(tmp_path / "g.ecsv", made))
    table = Table.read(tmp_path / "g.ecsv")
    for name in table.colnames:
        table[name].name = name.upper()
    table.write(tmp_path / "upper.csv")
    found = read_table(tmp_path / "upper.csv")
    np.testing.assert_array_equal(found.astrometry.values, wanted.astrometry.values)
    np.testing.assert_array_equal(found.astrometry.covariance(), wanted.astrometry.covariance())
    np.testing.assert_array_equal(found.astrometry.radial_velocity, wanted.astrometry.radial_velocity)
    np.testing.assert_array_equal(found.names["SOURCE_ID"], wanted.names["source_id"])


def test_gaia_as_vizier_has_it(tmp_path):
    made = stars(5)
    wanted = read_table(gaia(tmp_path / "g.ecsv", made)).astrometry
    table = Table.read(tmp_path / "g.ecsv")
    new = Table({"_RA": np.zeros(5), "_DE": np.zeros(5), "ref_epoch": table["ref_epoch"]})
    names = ("ra", "dec", "parallax", "pmra", "pmdec")
    for name, there in zip(names, ("RA_ICRS", "DE_ICRS", *VIZIER[2:]), strict=True):
        new[there], new[f"e_{there}"] = table[name], table[f"{name}_error"]
    for i, j in PAIRS:
        new[f"{VIZIER[i]}{VIZIER[j]}cor"] = table[f"{names[i]}_{names[j]}_corr"]
    new.write(tmp_path / "vizier.fits")
    found = read_table(tmp_path / "vizier.fits").astrometry
    np.testing.assert_array_equal(found.values, wanted.values)
    np.testing.assert_array_equal(found.covariance(), wanted.covariance())
    assert set(kinds(found)) == {"five-parameter"}
