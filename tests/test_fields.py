"""The table of fields: each written dataset has its type, shape and unit."""

from dataclasses import fields
from pathlib import Path

import h5py
import small_result

from msmpetsc.fields import DIMENSIONS, FIELDS, FRAME_FIELDS, STRESS, Frame


def test_a_frame_stores_all_but_its_index():
    assert list(FRAME_FIELDS) == [field.name for field in fields(Frame) if field.name != "index"]


def test_what_is_written_is_what_the_table_says(tmp_path: Path):
    sizes: dict[str, int] = {}
    with h5py.File(small_result.write(tmp_path / "x.h5")) as file:
        names: list[str] = []
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
        names = [
            name
            for name in names
            if name in FIELDS or name.removeprefix("frames/") not in DIMENSIONS.values()
        ]
        always = {
            name for name, field in FRAME_FIELDS.items() if not {*field.shape[1:]} & {*"acoblw"}
        } - {*STRESS}
        assert {f"frames/{name}" for name in always} < set(names) < set(FIELDS)
        for name in names:
            dataset, field = file[name], FIELDS[name]
            assert (dataset.dtype, dataset.attrs["units"]) == (field.dtype, field.unit), name
            for size, symbol in zip(dataset.shape, field.shape, strict=True):
                assert size == (
                    sizes.setdefault(symbol, size) if isinstance(symbol, str) else symbol
                ), name
