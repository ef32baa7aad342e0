"""``msmpetsc study``: sweep methods over scenes, and write a table and a report."""

import argparse
from pathlib import Path

from msmpetsc.comm import log
from msmpetsc.errors import InputError, printable
from msmpetsc.study.cases import shown_command
from msmpetsc.study.runner import list_study, part_folder, run_study
from msmpetsc.study.table import as_table, failed, swept


def run(args: argparse.Namespace) -> int:
    """Run the study and write its report; return the exit status."""
    part = part_of(args.part)
    folder = args.output or Path("out") / args.study.stem
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file, not a folder")
    if args.list:
        if part:
            raise InputError("--list lists the cases of all parts: leave out --part")
        listed = list_study(args.study, folder, args.full)
        # if N is the number of cases, --part I/N runs the case of number I
        for number, (case, done) in enumerate(listed, 1):
            state = "done" if done else "open"
            print(f"{number:4} {state}  {case.scene}: {case.label}  {shown_command(case)}")
        print(f"{len(listed)} cases, {sum(done for _, done in listed)} done")
        return 0
    rows = run_study(
        args.study, folder, full=args.full, jobs=args.jobs, restart=args.restart, part=part
    )
    # in a map a failed case is a result
    if lost := len(failed(swept(as_table(rows)))):
        log.warning("%d case%s without figures: see the column reason", lost, "s" * (lost > 1))
    # the study that joins the parts writes the report
    if part:
        print(part_folder(folder, part) / "table.csv")
        return 0
    # imported here, as loading the charts takes a second
    from msmpetsc.study.report import write_report

    print(write_report(folder))
    return 0


def part_of(text: str | None) -> tuple[int, int] | None:
    """Return the part that "3/16" names, the third of 16; None for None. Raises InputError."""
    if text is None:
        return None
    index, _, count = text.partition("/")
    numbers = all(part.isdecimal() and len(part) < 10 for part in (index, count))
    if not (numbers and 1 <= int(index) <= int(count)):
        raise InputError(f"--part must read I/N, 1 <= I <= N, not {printable(text, 40)}")
    return int(index), int(count)
