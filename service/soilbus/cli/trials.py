"""Commands that try the method: paper, decisions, bench.

Each function takes the parsed arguments, imports what it needs, does the work and prints a report or writes JSON.
"""

from __future__ import annotations

import argparse
import os
from contextlib import nullcontext

from soilbus.cli.common import configured, report
from soilbus.config.model import ConfigError
from soilbus.files import whole_file
from soilbus.words import WorkError


def paper(args: argparse.Namespace) -> None:
    """Run `soilbus paper`: the tables of Xi et al. 2024 beside ours."""
    from soilbus.trials.paper_report import paper_report

    print(paper_report(args.sinkage), end="")


def decisions(args: argparse.Namespace) -> None:
    """Run `soilbus decisions`: predictions beside what simulated drives then do."""
    from soilbus.trials.bogging_trials import warning_trials
    from soilbus.trials.decisions_report import as_json, decisions_report
    from soilbus.trials.draft_trials import draft_trials
    from soilbus.trials.draws import processes
    from soilbus.trials.verdict_trials import verdict_trials

    config = configured(args, or_reference=True)
    if config.tows_nothing:
        raise ConfigError(['vehicle.towing = "never": decisions are tried by drafts, which this vehicle never has'])
    with processes(os.cpu_count() or 1) as each:
        drafts = list(draft_trials(config, args.drives, args.seed, each=each))
        calls = verdict_trials(config, args.calls, args.seed, each=each)
        warnings = warning_trials(config, args.boggings, args.hours, args.seed, each=each)
    report(args.json, as_json(drafts, calls, warnings), decisions_report(drafts, calls, warnings))


def bench(args: argparse.Namespace) -> None:
    """Run `soilbus bench`: performance figures beside their peers."""
    import json

    from soilbus.trials.bench import bench_report, run_bench

    with nullcontext() if args.json is None else whole_file(args.json) as out:  # first, for it takes a minute
        try:
            results = run_bench()
        except (AssertionError, ModuleNotFoundError) as error:
            raise WorkError(f"bench: {error}") from None
        if out is not None:
            out.write(json.dumps(results, indent=1) + "\n")
    if str(args.json) != "-":
        print(bench_report(results), end="")
