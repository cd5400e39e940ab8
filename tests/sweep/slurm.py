"""A real SLURM of one node, on loopback, in a folder of its own."""

import os
import platform
import shutil
import socket
import subprocess
import time
from pathlib import Path

COMMANDS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel")


def why_not() -> str:
    """Return why SLURM cannot be started here, empty if it can."""
    if missing := [command for command in COMMANDS if not shutil.which(command)]:
        return f"{', '.join(missing)} not installed (Debian: slurm-wlm, munge)"
    return "" if os.geteuid() == 0 else "SLURM's daemons start as root"


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
        config = str(folder / "slurm.conf")
        self.daemons = [
            subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
            for command in (
                ["munged", "--foreground", "--force", *munge],
                ["slurmctld", "-D", "-c", "-f", config],
                ["slurmd", "-D", "-c", "-f", config],
            )
        ]
        deadline = time.monotonic() + 500
        while self.run("sinfo", "-h", "-o", "%T") != "idle":
            if time.monotonic() > deadline:
                self.close()
                raise RuntimeError((folder / "slurmctld.log").read_text()[-2000:])
            time.sleep(0.2)

    def run(self, *command: str) -> str:
        """Return what one of SLURM's commands prints."""
        done = subprocess.run(command, env=os.environ | self.environment, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    def close(self) -> None:
        """End all jobs and the daemons."""
        self.run("scancel", "-u", "root", "--signal=KILL")
        self.run("scancel", "-u", "root")
        time.sleep(1)
        for daemon in self.daemons[::-1]:
            daemon.terminate()
        for daemon in self.daemons:
            try:
                daemon.wait(10)
            except subprocess.TimeoutExpired:
                daemon.kill()
                daemon.wait()


def free_port() -> int:
    """Return a port on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
