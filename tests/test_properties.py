import json
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from support.checkpoints import load_checkpoint

from pp_cl.checkpoint import FORMAT, save_checkpoint
from pp_cl.config import assign, load_config, preset
from pp_cl.errors import MOST_LINE, UserError, one_line, quoted, shown
from pp_cl.files.run_folder import MOST_NUMBER, read_row
from pp_cl.scene.readers.common import MOST, read_numbers
from pp_cl.settings import Config, every_setting

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.text() | st.text(min_size=1).map(lambda text: text * 300))
def test_a_message_is_one_line_and_stays_as_it_is(text):
    line = one_line(text)
    assert (line.isprintable() or not line) and len(line) <= MOST_LINE and one_line(line) == line
    if text.isprintable() and len(text) <= MOST_LINE:
        assert line == text


@given(json_values, st.integers(10, 200))
def test_foreign_values_are_short(value, most):
    for line in (quoted(value, most), shown(str(value), most)):
        assert len(line) <= most and (line.isprintable() or not line)


SETTINGS = [(key, item) for key, _, item in every_setting(Config()) if not key.startswith("scene.")]


@st.composite
def given_settings(draw):
    """(A key, a value within its limits)."""
    key, item = draw(st.sampled_from(SETTINGS))
    limits, several = item.metadata, isinstance(item.default, tuple)
    kind = type(item.default[0]) if several else type(item.default)
    strategy = {
        bool: st.booleans(),
        str: st.sampled_from(limits["choices"] or [item.default]),
        int: st.integers(*(math.floor(limits[k] or 0) for k in ("least", "most"))),
        float: st.floats(*(float(limits[k] or 0) for k in ("least", "most"))),
    }[kind]
    value = draw(st.tuples(*[strategy] * len(item.default)) if several else strategy)
    return key, value


@given(given_settings())
def test_settings_are_themselves_again_from_their_file(tmp_path, pair):
    config = preset("tiny")
    config.scene.path = "demo"
    assign(config, *pair, "a test")
    (tmp_path / "config.json").write_text(config.to_json())
    try:
        assert load_config(tmp_path / "config.json") == config
    except UserError as error:  # rules other than limits
        first, last = config.train.offset_rate
        assert config.train.crop % 4 or (first > 0) != (last > 0)
        assert pair[0] in ("train.crop", "train.offset_rate") and pair[0] in str(error)


@given(st.integers(0, 10**9), finite.filter(lambda x: 0 <= x < MOST_NUMBER), json_values)
def test_a_row_of_the_log_is_finite_or_none(step, seconds, value):
    row = {"step": step, "seconds": seconds}
    assert read_row(json.dumps(row)) == row
    read = read_row(json.dumps(row | {"more": value}))
    assert read is None or json.loads(json.dumps(read, allow_nan=False)) == row | {"more": value}
    assert read_row(json.dumps(value)) is None or isinstance(value, dict)


@given(st.lists(st.lists(finite.filter(lambda x: abs(x) < MOST), min_size=1), max_size=6))
def test_numbers_in_a_text_come_back_exactly(tmp_path, rows):
    text = "\n\n".join(" ".join(map(repr, row)) for row in rows)
    (tmp_path / "a.txt").write_text(text)
    assert read_numbers(tmp_path / "a.txt") == rows


@given(st.dictionaries(st.from_regex(r"[a-z][a-z0-9.]{0,20}", fullmatch=True),
                       arrays.arrays(st.sampled_from([*"fdeLBq"]),
                                     arrays.array_shapes(min_dims=0, min_side=0, max_side=4),
                                     elements={"allow_nan": False, "allow_infinity": False}),
                       max_size=4))  # fmt: skip
def test_a_checkpoint_comes_back(tmp_path, stored):
    stored = {f"x.{name}": array for name, array in stored.items()}
    save_checkpoint(tmp_path / "a.npz", {"step": 1}, stored)
    header, loaded = load_checkpoint(tmp_path / "a.npz")
    assert header == {"format": FORMAT, "step": 1} and loaded.keys() == stored.keys()
    for name, array in stored.items():
        assert loaded[name].dtype == array.dtype and np.array_equal(loaded[name], array)
