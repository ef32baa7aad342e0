"""Curves over the number of valid cells: which rows make one curve."""

from msmpetsc.study import formatting
from msmpetsc.study.rows import Row, grouped, succeeded

QUALIFIERS = {"error": formatting.error, "max_iterations": formatting.count, "ranks": formatting.count}
WORDS = {"error": "error {}", "max_iterations": "{} iterations", "ranks": "{} ranks"}


def sweeps(rows: list[Row]) -> dict[tuple[str, float | None], list[Row]]:
    """Rows by (scene, time step), where some curve has two cell counts or more."""
    groups = grouped([row for row in succeeded(rows) if row["cells"]], lambda row: (row["scene"], row["time_step"]))
    return {key: group for key, group in groups.items() if any(map(is_swept, curves(group).values()))}


def is_swept(curve: list[Row]) -> bool:
    return len({row["cells"] for row in curve}) > 1


def curves(rows: list[Row]) -> dict[str, list[Row]]:
    """Rows by curve, each by rising cell count: a method, told apart by what else was varied within it."""
    varied = [name for name in QUALIFIERS if any(varies(name, group) for group in by_label(rows).values())]
    groups = grouped(rows, lambda row: ", ".join([row["label"], *qualifiers(row, varied)]))
    return {name: sorted(group, key=lambda row: row["cells"]) for name, group in groups.items()}


def by_label(rows: list[Row]) -> dict[str, list[Row]]:
    return grouped(rows, lambda row: row["label"])


def varies(column: str, rows: list[Row]) -> bool:
    return len({row[column] for row in rows}) > 1


def qualifiers(row: Row, columns: list[str]) -> list[str]:
    """What tells two curves of one label apart."""
    return [WORDS[name].format(QUALIFIERS[name](row[name])) for name in columns if row[name] is not None]


def titled(kind: str, scene: str, time_step: float | None) -> str:
    return f"{kind}: {scene}" + (f", time step {formatting.seconds(time_step)}" if time_step else "")


def file_name(kind: str, scene: str, time_step: float | None, groups: dict) -> str:
    """The kind alone where there is one chart of it, else with what tells them apart."""
    if len(groups) == 1:
        return kind
    alone = [key for key in groups if key[0] == scene] == [(scene, time_step)]
    return f"{kind}_{scene}" if alone else f"{kind}_{scene}_{formatting.plain(time_step)}"
