"""The job scripts run under mpirun with stand-ins for srun, scontrol and the program."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from conftest import AS_ROOT, ROOT

SCRIPTS = sorted((ROOT / "scripts" / "slurm").glob("*.sbatch"))
RUNS = [path for path in SCRIPTS if path.stem != "array"]
STAND_INS = {
    # ignores the options of srun; mpirun, too, passes USR1 to its ranks
    "srun": """while [[ $1 == --* ]]; do shift; done
        exec mpirun --oversubscribe -n 2 "$@" """,
    "scontrol": 'echo "$@" >> requeued',
    # behaves like msmpetsc run and msmpetsc study on a signal and with --resume
    "msmpetsc": """echo "$@ threads=$OMP_NUM_THREADS" >> "told-$$"
        trap 'touch "$4"; exit 0' USR1
        trap 'exit 130' TERM
        if [[ $2 == --resume ]]; then echo "nothing left to do"; exit 0; fi
        if [[ -e done ]]; then exit "$(cat done)"; fi
        touch "ready-$$"
        for _ in {1..600}; do sleep 0.05; done
        exit 1""",
}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_slurm_finds_its_directives(script: Path):
    """All directives come before the first command, where Slurm stops looking."""
    directives = script.read_text().partition("set -euo pipefail")[0]
    assert "#SBATCH --signal=B:USR1@120\n" in directives and "#SBATCH --requeue\n" in directives


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
def test_shellcheck_finds_nothing():
    scripts = [*SCRIPTS, ROOT / "scripts" / "build_petsc_cuda"]
    done = subprocess.run(["shellcheck", *scripts], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


class Job:
    """A job script in its own folder, with its two lines edited."""

    def __init__(self, script: Path, folder: Path):
        self.folder = folder
        for name, body in STAND_INS.items():
            (folder / "bin").mkdir(exist_ok=True)
            (folder / "bin" / name).write_text(f"#!/usr/bin/env bash\n{body}\n")
            (folder / "bin" / name).chmod(0o755)
        (folder / "setup.sh").write_text(f'PATH={folder}/bin:$PATH; : "$NOT_SET_ANYWHERE"\n')
        lines = script.read_text().splitlines()
        edited = {"scene": "fall.toml", "study": "growth.toml", "setup": f"{folder}/setup.sh"}
        for number, line in enumerate(lines):
            if "# EDIT" in line:
                name = line.partition("=")[0]
                lines[number] = f"{name}={edited[name]}"
        self.script = folder / "job.sh"
        self.script.write_text("\n".join(lines))

    def start(self) -> subprocess.Popen:
        """Start the script as Slurm does, for the first time or again."""
        ids = {"JOB_ID": 77, "ARRAY_JOB_ID": 70, "ARRAY_TASK_ID": 3, "ARRAY_TASK_MAX": 16}
        slurm = {f"SLURM_{name}": str(number) for name, number in ids.items()}
        foreign = ("OMPI_COMM", "PMIX", "OMP_NUM_THREADS")
        own = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
        environment = {**own, **AS_ROOT, **slurm}
        return subprocess.Popen(
            ["bash", self.script], cwd=self.folder, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    def stopped(self, ranks: int) -> str:
        """Return the output of a script that Slurm stops once so many ranks run."""
        process = self.start()
        while len(list(self.folder.glob("ready-*"))) < ranks:
            assert process.poll() is None, process.communicate()[0]
            time.sleep(0.02)
        process.send_signal(signal.SIGUSR1)
        output, _ = process.communicate()
        assert process.returncode == 0, output
        return output

    def status(self) -> int:
        """Start the script again and return its status."""
        process = self.start()
        process.communicate()
        return process.returncode

    def told(self) -> list[str]:
        """Return the arguments of each rank of each call of the program, and forget them."""
        calls = sorted(self.folder.glob("told-*"))
        lines = [line for call in calls for line in call.read_text().splitlines()]
        for call in calls:
            call.unlink()
        return lines

    @property
    def requeued(self) -> list[str]:
        path = self.folder / "requeued"
        return path.read_text().splitlines() if path.exists() else []


@pytest.mark.parametrize("script", RUNS, ids=lambda path: path.stem)
def test_a_run_out_of_time_is_queued_again_and_goes_on(script: Path, tmp_path: Path):
    job, result = Job(script, tmp_path), "out/fall-77.h5"
    petsc = " -mat_type aijcusparse" if script.stem == "gpu" else ""
    job.stopped(2)
    assert job.told() == [f"run fall.toml -o {result}{petsc} threads=1"] * 2
    assert job.requeued == ["requeue 77"] and (tmp_path / result).exists()
    assert job.status() == 0
    assert job.told() == [f"run --resume {result}{petsc} threads=1"] * 2
    # the job is not requeued again
    assert job.requeued == ["requeue 77"]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_fails_is_not_queued_again(script: Path, tmp_path: Path):
    job = Job(script, tmp_path)
    (tmp_path / "done").write_text("3")
    assert job.status() == 3 and job.requeued == []


def test_a_task_of_an_array_is_queued_again_until_its_part_is_done(tmp_path: Path):
    job = Job(SCRIPTS[0], tmp_path)
    assert "queued again" in job.stopped(1)
    assert job.told() == ["study growth.toml --part 3/16 threads=1"]
    assert job.requeued == ["requeue 70_3"]
    (tmp_path / "done").write_text("0")
    assert job.status() == 0 and job.requeued == ["requeue 70_3"]
