"""What was checked, as the JUnit XML that continuous integration reads."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from msmpetsc.output.disk import write_whole


@dataclass(frozen=True)
class Checked:
    """A scene that was run and held against its numbers.

    lines   : for each count and number what is wrong with it, nothing for what is as stored
    seconds : that the run took
    """

    scene: Path
    lines: Mapping[str, str]
    seconds: float

    @property
    def wrong(self) -> list[str]:
        """What is not as stored, a line each."""
        return [line for line in self.lines.values() if line]


def write_junit(path: Path, outcomes: list[Checked]) -> None:
    """Write a suite for each scene, a case for each number. Raises InputError."""
    root = ElementTree.Element("testsuites", name="msmpetsc check")
    for outcome in outcomes:
        counts = {"tests": str(len(outcome.lines)), "failures": str(len(outcome.wrong))}
        suite = ElementTree.SubElement(root, "testsuite", {"name": str(outcome.scene), "errors": "0"} | counts)
        suite.set("time", f"{outcome.seconds:.3f}")
        for name, line in outcome.lines.items():
            case = ElementTree.SubElement(suite, "testcase", classname=outcome.scene.stem, name=name)
            if line:
                ElementTree.SubElement(case, "failure", message=line).text = line
    write_whole(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
