"""A scheduler and workers that speak TLS, with certificates made here."""

from contextlib import closing

import pytest
import trustme

from tests.sweep.opening import same
from tests.sweep.outside import Outside


class Files:
    """An authority's certificate, and a certificate of its with the key."""

    def __init__(self, folder):
        folder.mkdir()
        authority = trustme.CA()
        issued = authority.issue_cert("localhost", "127.0.0.1")
        self.ca, self.cert, self.key = (str(folder / f"{part}.pem") for part in ("ca", "cert", "key"))
        authority.cert_pem.write_to_path(self.ca)
        issued.private_key_and_cert_chain_pem.write_to_path(self.cert)
        issued.private_key_pem.write_to_path(self.key)

    def options(self, ca="--tls-ca"):
        return (ca, self.ca, "--tls-cert", self.cert, "--tls-key", self.key)


@pytest.fixture
def files(tmp_path):
    return Files(tmp_path / "tls")


@pytest.fixture
def outside(tmp_path, files):
    (tmp_path / "dask").mkdir()
    with closing(Outside(tmp_path / "dask", *files.options("--tls-ca-file"), protocol="tls")) as outside:
        assert outside.address.startswith("tls://127.0.0.1:")
        outside.start_worker()
        yield outside


@pytest.mark.slow
def test_a_study_runs_over_tls(link_study, tmp_path, sweep, files, outside):
    study = ("run", link_study, "--set", "n_sim=50", "-o")
    code, _, err = sweep(*study, tmp_path / "tls.zarr", "--scheduler", outside.address, *files.options())
    assert code == 0, err
    assert f"the Dask scheduler at {outside.address}" in err
    code, _, err = sweep(*study, tmp_path / "serial.zarr", "--pool", "serial")
    assert code == 0, err
    same(tmp_path / "serial.zarr", tmp_path / "tls.zarr")


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["strangers", "none", "rubbish"])
def test_wrong_certificates_are_refused_in_a_sentence(link_study, tmp_path, sweep, outside, wrong):
    strangers = Files(tmp_path / "strangers")
    if wrong == "rubbish":
        (tmp_path / "strangers" / "key.pem").write_text("no key\n")
    options = () if wrong == "none" else strangers.options()
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", "--scheduler", outside.address, *options)
    assert code == 2, err
    assert len(err.splitlines()) == 1, err
    says = {"rubbish": "cannot use the TLS files", "none": "no certificates for", "strangers": "no Dask scheduler"}
    assert err.startswith(f"error: {says[wrong]}"), err
    assert not (tmp_path / "s.zarr").exists()
