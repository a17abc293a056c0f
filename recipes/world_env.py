"""The whole loop of World-Env (arXiv 2509.24948) in one command.

From a few demonstrations per task to a policy post-trained by reinforcement learning inside a learned world model::

    python recipes/world_env.py smoke      # every stage for real, at most 6 minutes on 2 cores
    python recipes/world_env.py improve    # meant to raise held-out success: half an hour; extra vision
    python recipes/world_env.py real-size --real-size.policy FOLDER ...    # pretrained parts: recipes/README.md
    python recipes/world_env.py improve --help
    python recipes/world_env.py improve --dry-run [--gpus 8] [--gpu H100] [--matmul-share 0.3]    # its plan alone

The same command continues an interrupted run: finished stages are skipped, the running one goes on from its last
checkpoint, to the same weights bit for bit.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing

import processes
import report
from adapt import adapt
from command_line import refusals
from config import WorldEnvConfig
from demonstrate import demonstrate
from dry_run import dry_run, split
from evaluate import evaluate
from explore import explore
from parts import Parts
from post_train import post_train
from run import Run
from sft import fine_tune
from stages import Work, open_run, parse, plan, run_stages
from train_reflector import train_reflector
from train_world_model import train_world_model
from worldenv_trl.report import plot_run, summary_table

WORKS: dict[str, Work] = {
    "demonstrate": demonstrate,
    "sft": fine_tune,
    "explore": explore,
    "train_world_model": train_world_model,
    "train_reflector": train_reflector,
    "adapt": adapt,
    "post_train": post_train,
    "evaluate": evaluate,
}


def run_all(config: WorldEnvConfig, parts: Parts | None = None) -> None:
    """Runs what is not finished yet, then prints the table and writes the plots and the report; the parts are those
    that the settings name, unless others are given."""
    run = open_run(config, parts)
    with closing(run.folder.loggers), closing(run):
        run_stages(run, WORKS)
        with refusals():
            processes.on_main(lambda: _conclude(run))


def _conclude(run: Run) -> None:
    loggers = run.folder.loggers
    loggers.images(plot_run(run.folder.path))
    summarize(run)
    page = run.folder.path / "report.html"
    if page.exists():
        loggers.page(page)


def summarize(run: Run) -> None:
    """Prints the table and writes the report, where the policy can be evaluated here."""
    config, folder = run.config, run.folder.path
    if plan(config)[-1].kind != "evaluate":
        print(f"{folder / 'checkpoints' / 'sft'}: its actions are for LIBERO's controller (recipes/README.md, LIBERO)")
        return
    print(summary_table(folder))
    print(
        "Success in %, [95 % Wilson intervals], p of an exact McNemar test on the same initial states. "
        "physics: the goal predicate ends an episode; reflector: nothing but the reflector does."
    )
    episodes = max(min(config.evaluate.episodes_per_task // 5, report.Report.episodes_per_task), 1)
    settings = report.Report(folder, episodes_per_task=episodes, num_threads=config.num_threads, device=config.device)
    try:
        report.write(settings, run.parts)
    except Exception as error:  # the run itself is whole
        again = f"python recipes/report.py {folder}"
        print(f"warning: the report could not be written ({error}); after a remedy: {again}", file=sys.stderr)


def main(arguments: Sequence[str]) -> int:
    """The command; with ``--dry-run`` only its plan."""
    planned, settings = split(arguments)
    config = parse(settings)
    if planned is not None:
        return 1 if dry_run(config, planned) else 0
    run_all(config)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
