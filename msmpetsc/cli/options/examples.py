"""The examples that the help of each command ends with."""

import argparse

EXAMPLES_HEAD = "examples:"
EXAMPLES: dict[str, tuple[str, ...]] = {
    "new": (
        "msmpetsc new my.toml --mesh my.ply",
        "msmpetsc new --list",
        "msmpetsc new my.toml --from bunny_fall",
    ),
    "run": (
        "msmpetsc run my.toml --picture",
        "msmpetsc run my.toml -o out/coarse.h5 --set cages.count=1000 --overwrite",
        "msmpetsc run my.toml --error 1e-4 --measure out/cost.json -ksp_type pipecg -log_view",
        "msmpetsc run --resume out/my.h5",
    ),
    "inspect": ("msmpetsc inspect my.toml --ranks 64", "msmpetsc inspect my.toml --json"),
    "study": ("msmpetsc study my_study.toml --list", "msmpetsc study my_study.toml -o out/my_study --jobs 2"),
    "plan": (
        "msmpetsc plan my.toml --surface-error 0.1 --write",
        "msmpetsc plan my.toml --surface-error 0.03 --frames 10 --chart out/plan.png",
    ),
    "compare": ("msmpetsc compare out/a.h5 out/b.h5 --rtol 1e-3", "msmpetsc compare out/a.h5 out/b.h5 --json"),
    "render": (
        "msmpetsc render out/my.h5 --frames 0,10,20 --eye=-1,2,0.5",
        "msmpetsc render out/my.h5 -o out/my.mp4 --speed 0.1",
        "msmpetsc render out/my.h5 -o out/my.html --colour strain",
        "msmpetsc render out/my.h5 -o out/turn.gif --turntable --size 480x360",
        "msmpetsc render my.toml --show cells",
    ),
    "export": (
        "msmpetsc export out/my.h5 -o out/my.glb --every 2",
        "msmpetsc export out/my.h5 -o out/last.obj --frames -1",
    ),
    "check": (
        "msmpetsc check my.toml --update --cells 400 --frames 10",
        "msmpetsc check my.toml other.toml --ranks 2 --junit out/check.xml",
    ),
    "fetch": ("msmpetsc fetch --list", "msmpetsc fetch bunny armadillo"),
    "keys": ("msmpetsc keys", "msmpetsc keys material", "msmpetsc keys pin.region"),
    "schema": ("msmpetsc schema > msmpetsc.schema.json",),
    "doctor": ("msmpetsc doctor",),
    "completion": (
        "msmpetsc completion bash > ~/.local/share/bash-completion/completions/msmpetsc",
        "msmpetsc completion fish > ~/.config/fish/completions/msmpetsc.fish",
    ),
}


class ExamplesKept(argparse.HelpFormatter):
    """Formats help, and leaves the lines of examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:  # where argparse wraps description and epilog
        return text if text.startswith(EXAMPLES_HEAD) else super()._fill_text(text, width, indent)
