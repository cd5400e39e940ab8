"""Experiments and studies as a user writes them: files in a folder, and the real command."""

import textwrap

EXPERIMENT = """
from linksweep.sweep.contract import Experiment, Output, Parameter

{before}

def evaluate(points, n_sim, rng, catalogue_rng):
    return {evaluate}

experiment = Experiment(
    name="user", version=1,
    parameters=({parameters}),
    sums={sums}, outputs=({outputs}),
    evaluate=evaluate, summarise=lambda sums, n, n_cat: {summarise},
    {rest}
)
"""
PARTS = {"parameters": 'Parameter("rate", "float", 1.0, "rate"), Parameter("kind", "int", 0, "which")', "before": ""}
PARTS |= {"evaluate": '{"total": [n_sim * p["rate"] for p in points]}', "sums": '{"total": ()}', "rest": ""}
PARTS |= {"outputs": 'Output("mean", "", "mean", headline=True),', "summarise": '{"mean": sums["total"] / n}'}


def write_experiment(folder, name="user.py", **parts):
    parts = PARTS | {key: textwrap.dedent(part) for key, part in parts.items()}
    text = EXPERIMENT
    for key, part in parts.items():
        text = text.replace(f"{{{key}}}", part)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def write_study(folder, axes="rate = [1.0, 2.0]", sampling="n_sim = 4", experiment="user.py:experiment", rest=""):
    text = f'title = "t"\nexperiment = "{experiment}"\n{rest}\n[axes]\n{axes}\n[sampling]\n{sampling}\n'
    (folder / "s.toml").write_text(text)
    return folder / "s.toml"


def law(a: float = 1.0, n: int = 2, m: str = "x", e=None):
    return a
