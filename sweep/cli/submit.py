"""The command that writes, and submits, a job array which computes a study in parts and merges them."""

import shlex
import subprocess
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import click

import linksweep
from linksweep.sweep.cli import options
from linksweep.sweep.cli.group import command
from linksweep.sweep.cli.options import flag, many, opt

# `afterany`: a part in which points fail ends with exit code 1.  A lock that is left over on another host is that of
# an earlier try: SLURM runs a task once at a time.
SCRIPT = """\
#!/bin/sh
# Submits {name} as a job array of {total} parts, and a job that merges them when all have ended.
set -e
array=$(sbatch --parsable --array=1-{total} --job-name={name} --output={folder}/%A_%a.log{more} <<'END_OF_JOB'
#!/bin/bash
cd {here} || exit
exec {run} --part "$SLURM_ARRAY_TASK_ID/{total}" --workers "${{SLURM_CPUS_PER_TASK:-1}}" --break-lock
END_OF_JOB
)
echo "job array $array"
sbatch --dependency="afterany:${{array%%;*}}" --job-name={name} --output={folder}/merge-%j.log{more} <<'END_OF_JOB'
#!/bin/bash
cd {here} || exit
exec {merge}
END_OF_JOB
"""


@command("Run", "Run a study as a job array of SLURM")
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
    from linksweep.sweep.formatting import counted
    from linksweep.sweep.planning.grid import make_grid
    from linksweep.sweep.planning.parts import deal
    from linksweep.sweep.planning.plan import Plan
    from linksweep.sweep.running.merge import require_free
    from linksweep.sweep.stores.location import Folder

    study, store = asked.load()
    costs: dict[int, float] = defaultdict(float)
    for unit, number in deal(Plan(make_grid(study)), tasks):
        costs[number] += unit.cost
    require_free(store, study, [{"study_digest": study.digest(), "parts": tasks}])
    pairs = [("--set", asked.settings), ("--axis", asked.axes), ("--range", asked.ranges)]
    pairs += [
        ("--points", [asked.points] if asked.points else []),
        ("--design", [asked.design] if asked.design else []),
    ]
    overrides = [word for name, values in pairs for value in values for word in (name, value)]
    trust = ["--trust"] if asked.trust else []
    sweep, place = [sys.executable, "-P", "-m", "linksweep"], shlex.quote(str(store))
    merge = shlex.join([*sweep, "merge", *(["--trust"] if asked.trust or not study.is_ours else []), "-o", str(store)])
    folder = (store.path.parent if isinstance(store, Folder) else Path.cwd()) / f"{store.name}.slurm"
    script = SCRIPT.format(
        name=shlex.quote(study.name),
        total=tasks,
        folder=shlex.quote(str(folder)),
        here=shlex.quote(str(Path.cwd())),
        more="".join(f" {shlex.quote(option)}" for option in more),
        run=shlex.join([*sweep, "run", asked.study, *overrides, *trust, "-o", str(store)]),
        merge=f"{merge} {place}.part-{{1..{tasks}}}-of-{tasks}",
    )
    file = folder / "submit.sh"
    try:
        if file.exists() and file.read_text() != script:
            raise linksweep.SweepError("is there already, and another one; submit it with sh, or remove it", str(file))
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(script)
    except OSError as error:
        raise linksweep.SweepError(f"cannot be written: {error.strerror}", str(file)) from error
    even = max(costs.values()) * len(costs) / sum(costs.values())
    click.echo(
        f"{counted(len(costs), 'part')} with work, the largest {even:.2f} times the mean; wrote {file}", err=True
    )
    if not go:
        click.echo(f"sh {shlex.quote(str(file))}")
        return
    try:
        subprocess.run(["sh", str(file)], check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise linksweep.SweepError(f"could not be submitted: {error}", str(file)) from error
