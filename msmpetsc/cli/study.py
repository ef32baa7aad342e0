"""``msmpetsc study``: sweep methods over scenes, into one table and a report."""

import argparse
import signal
from pathlib import Path

from mpi4py import MPI

from msmpetsc.comm import log
from msmpetsc.errors import InputError


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "study",
        help="sweep methods over scenes",
        description="Run the cases of a study, each in its own process, into a table and a report. "
        "Stopped, the same command goes on.",
    )
    parser.add_argument("study", type=Path, metavar="FILE.toml", help="study file")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="default: out/FILE")
    parser.add_argument("--full", action="store_true", help="also what is marked full = true: the long cases")
    parser.add_argument("--jobs", type=int, metavar="N", help="cases at a time (they slow each other)")
    parser.add_argument("--restart", action="store_true", help="forget the cases that are done")


def run(args: argparse.Namespace) -> int:
    """Run the study and write its report; returns the exit status."""
    refuse_ranks("study")
    if args.jobs is not None and args.jobs < 1:
        raise InputError(f"--jobs must be at least 1, not {args.jobs}")
    from msmpetsc.solve.presets import PRESETS
    from msmpetsc.study.study import run_study

    signal.signal(signal.SIGTERM, stop)
    folder = args.output or Path("out") / args.study.stem
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file, not a folder")
    try:
        rows = run_study(args.study, folder, PRESETS, args.full, args.jobs, args.restart)
    except OSError as error:  # of the folder, of a full disk, of an mpiexec that is not there
        raise InputError(f"{error.filename or folder}: {error.strerror}") from None
    tell_of(rows)
    from msmpetsc.study.report import write_report  # loads the charts: a second that refused files need not wait

    print(write_report(folder))
    return 0


def tell_of(rows: list[dict]) -> None:
    """What to look at: cases that failed; and of each map how it went, for there failing is an answer."""
    from msmpetsc.study.outcome import counted
    from msmpetsc.study.rows import mapped, swept

    failed = sum(row["status"] != "ok" for row in swept(rows))
    if failed:
        log.warning("%d case%s without figures: see the column reason", failed, "s" * (failed > 1))
    for name, group in mapped(rows).items():
        log.info("map %s: %s", name, counted(group))


def stop(*_) -> None:
    """A signal to end is Ctrl-C: the runs under way end with this process."""
    raise KeyboardInterrupt


def refuse_ranks(command: str) -> None:
    """Cases start mpiexec themselves."""
    if MPI.COMM_WORLD.size > 1:
        raise InputError(f"{command} is started without mpiexec: it starts its runs on as many ranks as they need")
