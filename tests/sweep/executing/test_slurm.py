"""A study on a real SLURM: through dask-jobqueue, and as a job array of parts."""

import os
import platform
import shutil
import subprocess
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest

from tests.sweep.conftest import free_port
from tests.sweep.executing.test_faults import LONG, reference, start, to_its_end
from tests.sweep.opening import same
from tests.sweep.outside import wait_until

COMMANDS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel")
WANTING = [command for command in COMMANDS if not shutil.which(command)] + ["root"] * (os.geteuid() != 0)
__all__ = ["reference", "start"]
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(WANTING), reason=f"needs {WANTING} (slurm-wlm, munge)")]


class Slurm:
    """A controller and one node of four processors; `environment` lets SLURM's commands find it."""

    def __init__(self, folder: Path) -> None:
        name = platform.node().partition(".")[0]
        folder.chmod(0o755)
        self.environment = {"SLURM_CONF": str(folder / "slurm.conf")}
        (folder / "key").write_bytes(os.urandom(1024))
        (folder / "key").chmod(0o400)
        (folder / "slurm.conf").write_text(f"""
ClusterName=test
SlurmctldHost={name}(127.0.0.1)
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_interval=1
ReturnToService=2
SlurmdParameters=config_overrides
KillWait=2
NodeName={name} NodeAddr=127.0.0.1 CPUs=4 RealMemory=4000 State=UNKNOWN
PartitionName=short Nodes={name} Default=YES MaxTime=INFINITE State=UP OverSubscribe=FORCE
""")
        munge = [f"--{part}-file={folder}/munge.{part}" for part in ("pid", "log", "seed")]
        munge += [f"--key-file={folder}/key", f"--socket={folder}/munge.socket"]
        commands = [["munged", "--foreground", "--force", *munge]]
        commands += [[daemon, "-D", "-c", "-f", str(folder / "slurm.conf")] for daemon in ("slurmctld", "slurmd")]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.daemons = [subprocess.Popen(command, **quiet, start_new_session=True) for command in commands]
        try:
            wait_until(lambda: self.run("sinfo", "-h", "-o", "%T") == "idle", "a node", 500)
        except AssertionError as error:
            self.close()
            raise RuntimeError((folder / "slurmctld.log").read_text()[-2000:]) from error

    def run(self, *command: str) -> str:
        how = {"env": os.environ | self.environment, "capture_output": True, "text": True}
        return subprocess.run(command, check=False, **how).stdout.strip()

    def close(self) -> None:
        self.run("scancel", "-u", "root", "--signal=KILL")
        self.run("scancel", "-u", "root")
        time.sleep(1)
        for daemon in self.daemons[::-1]:
            daemon.terminate()
            with suppress(subprocess.TimeoutExpired):
                daemon.wait(10)
            daemon.kill()
            daemon.wait()


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    with closing(Slurm(tmp_path_factory.mktemp("slurm"))) as slurm:
        yield slurm


@pytest.fixture(autouse=True)
def found_by_commands(slurm, monkeypatch):
    for name, value in slurm.environment.items():
        monkeypatch.setenv(name, value)


def cluster_file(folder, size):
    (folder / "slurm.toml").write_text(f"""
class = "dask_jobqueue.SLURMCluster"
{size}
[options]
cores = 1
memory = "1GB"
walltime = "00:10:00"
interface = "lo"
log_directory = "{folder / "log"}"
local_directory = "{folder / "scratch"}"
""")
    return folder / "slurm.toml"


def jobs(slurm):
    return slurm.run("squeue", "-h", "-t", "running", "-o", "%i").split()


@pytest.mark.parametrize("size", ["scale = 2", "adapt = { minimum = 0, maximum = 2 }"])
def test_a_study_runs_in_jobs(start, tmp_path, slurm, reference, size):
    assert "the SLURMCluster of" in to_its_end(start("--cluster", cluster_file(tmp_path, size), waits=False))
    same(tmp_path / "s.zarr", reference)
    wait_until(lambda: not jobs(slurm), "the end of the jobs")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log", "s.zarr", "scratch", "slurm.toml", "small.toml"]


@pytest.mark.parametrize("cancelled", [1, 2], ids=["one of two jobs", "all jobs"])
def test_cancelled_jobs_cost_nothing_but_time(start, tmp_path, slurm, reference, cancelled):
    process = start("--cluster", cluster_file(tmp_path, "scale = 2"))
    wait_until(lambda: len(jobs(slurm)) == 2, "two jobs")
    slurm.run("scancel", *jobs(slurm)[:cancelled])
    to_its_end(process)
    same(tmp_path / "s.zarr", reference)


def test_a_job_array_computes_the_parts_and_merges_them(link_study, tmp_path, sweep, slurm, reference):
    store = tmp_path / "s.zarr"
    asked = ("submit", link_study, "-o", store, *LONG, "--slurm=4", "--sbatch=--mem=500M", "--sbatch=--array=1,2,4%2")

    def ended():
        wait_until(lambda: not slurm.run("squeue", "-h"), "the end of all jobs")
        return "\n".join(path.read_text() for path in sorted((tmp_path / "s.zarr.slurm").glob("merge-*.log")))

    job = slurm.run("sbatch", "--parsable", "--output=/dev/null", "--wrap=sleep 2")
    sweep(*asked, f"--sbatch=--dependency=afterany:{job}", "--sbatch=--output=/dev/null", cwd=tmp_path, code=0)
    script = tmp_path / "s.zarr.slurm" / "submit.sh"
    slurm.run("sh", str(script))
    assert "lost parts: 3 of 4" in ended()
    assert "lost parts: 3 of 4" in sweep("status", store)[1]
    script.write_text(script.read_text().replace("1,2,4%2", "3"))
    slurm.run("sh", str(script))
    assert "wrote" in ended()
    same(store, reference)
