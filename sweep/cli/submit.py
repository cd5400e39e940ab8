"""The command that writes, and submits, a job array which computes a study in parts and merges them."""

import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import click

import linksweep
from linksweep.sweep.cli import group, options
from linksweep.sweep.cli.options import flag, many, opt

# `afterany`: a part in which points fail ends with exit code 1.  A lock that is left over on another host is that of
# an earlier try: SLURM runs a task once at a time.
SCRIPT = """\
#!/bin/sh
# Submits {name} as a job array of {total} parts, and a job that merges them when all have ended.
set -e
array=$(sbatch --parsable --array=1-{total} --output={folder}/%A_%a.log {options} <<'END_OF_JOB'
#!/bin/bash
exec {run} --part "$SLURM_ARRAY_TASK_ID/{total}" --workers "${{SLURM_CPUS_PER_TASK:-1}}" --break-lock
END_OF_JOB
)
sbatch --dependency="afterany:${{array%%;*}}" --output={folder}/merge-%j.log {options} <<'END_OF_JOB'
#!/bin/bash
exec {merge} {store}.part-{{1..{total}}}-of-{total}
END_OF_JOB
"""


@group.command("Run", "Run a study as a job array of SLURM")
def submit(
    asked: options.AskedStudy = options.group(options.AskedStudy),
    tasks: int = opt("Tasks of the array, a part in each.", "--slurm", type=click.IntRange(1, 100_000), required=True),
    more: Sequence[str] = many("For sbatch, for all jobs, e.g. --time=2:00:00.", "--sbatch", metavar="OPTION"),
    go: bool = flag("Submit it, too."),
) -> None:
    """Write STORE.slurm/submit.sh, which submits STUDY as a job array of SLURM, with a part of it in each task, and a
    job that merges the parts; logs go beside it.  No task needs a connection to another.

    \b
    sweep submit quasars --slurm 100 --sbatch --time=1:00:00
    sweep submit quasars --slurm 100 --go
    """
    from linksweep.sweep.planning.grid import make_grid
    from linksweep.sweep.running.merge import require_free
    from linksweep.sweep.stores.location import Folder

    study, store = asked.load()
    make_grid(study)  # its mistakes are named here, not in a hundred logs
    require_free(store, study, [{"study_digest": study.digest(), "parts": tasks}])
    changes = {"--set": asked.settings, "--axis": asked.axes, "--range": asked.ranges}
    changes |= {"--points": [asked.points or ""], "--design": [asked.design or ""], "--exclude": asked.exclude}
    overrides = [f"{name}={value}" for name, values in changes.items() for value in values if value]
    trust = ["--trust"] if asked.trust else []
    sweep = [sys.executable, "-P", "-m", "linksweep"]
    folder = (store.path.parent if isinstance(store, Folder) else Path.cwd()) / f"{store.name}.slurm"
    script = SCRIPT.format(
        name=shlex.quote(study.name),
        total=tasks,
        folder=shlex.quote(str(folder)),
        options=shlex.join([f"--job-name={study.name}", f"--chdir={Path.cwd()}", *more]),
        run=shlex.join([*sweep, "run", asked.study, *overrides, *trust, "-o", str(store)]),
        # Who submits a study trusts its code; parts are written on other hosts than the one that merges them.
        merge=shlex.join([*sweep, "merge", *(trust if study.is_ours else ["--trust"]), "-o", str(store)]),
        store=shlex.quote(str(store)),
    )
    file = folder / "submit.sh"
    try:
        if file.exists() and file.read_text() != script:
            raise linksweep.SweepError("is there already, and another one; submit it with sh, or remove it", str(file))
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(script)
        click.echo(f"wrote {file}" + ("" if go else f"; submit it with: sh {shlex.quote(str(file))}"), err=True)
        if go:
            subprocess.run(["sh", str(file)], check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise linksweep.SweepError(f"cannot be written or submitted: {error}", str(file)) from error
