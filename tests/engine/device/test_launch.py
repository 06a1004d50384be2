import numpy as np
import pyopencl as cl
import pytest
from support.toy_kernels import SOURCE

from pp_cl.engine.device import device as device_module
from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.device.launch import replayed
from pp_cl.engine.device.signature import SCALARS, parse_signatures
from pp_cl.errors import UserError

KERNEL_FOLDER = device_module.kernel_folder()  # before any test replaces it
ENQUEUE = "enqueue_nd_range_kernel"  # pyopencl's
STEMS = sorted(
    p.relative_to(KERNEL_FOLDER).with_suffix("").as_posix() for p in KERNEL_FOLDER.rglob("*.cl")
)


@pytest.fixture
def program(dev, tmp_path, monkeypatch):
    (tmp_path / "toy.cl").write_text(SOURCE)
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path)
    dev._programs.pop(("toy", frozenset()), None)
    yield dev.program("toy")
    dev._programs.pop(("toy", frozenset()), None)


@pytest.fixture
def rows(dev, rng):
    return {
        "n": 33,
        "scale": 2.0,
        "x": dev.upload(rng.random((33, 4)), np.float32),
        "k": dev.upload(np.arange(3), np.uint32),
        "y": dev.empty((33, 1)),
    }


def test_a_launch_computes(program, dev, rows):
    """A letter may stand for another size in the next launch; numpy's numbers are accepted."""
    program.launch("rows", (np.uint32(33),), local=(8,), **rows | {"n": np.int64(33)})
    expected = 2 * rows["x"].get().sum(1) + np.arange(33) % 3
    np.testing.assert_allclose(rows["y"].get()[:, 0], expected, rtol=1e-6)
    fewer = rows | {"n": 31, "x": rows["x"][:31], "y": dev.empty((31, 1))}
    program.launch("rows", 31, **fewer)
    np.testing.assert_allclose(fewer["y"].get()[:, 0], expected[:31], rtol=1e-6)


@pytest.mark.parametrize(
    "size, local, enqueued",
    [
        (1, None, ((64,), (64,))),
        (65, None, ((128,), (64,))),
        (5, 4, ((8,), (4,))),
        ((17, 5), None, ((32, 8), (16, 4))),
        ((np.uint32(3), 1, 1), None, ((16, 4, 1), (16, 4, 1))),
    ],
)
def test_sizes_are_rounded_up_to_the_work_group(program, rows, monkeypatch, size, local, enqueued):
    ranges = []
    monkeypatch.setattr(cl, ENQUEUE, lambda queue, kernel, *args: ranges.append(args[:2]))
    program.launch("rows", size, local=local, **rows)
    assert ranges == [enqueued]


def test_a_size_of_zero_launches_nothing(program, rows):
    program.launch("rows", (4, 0), **rows)
    assert np.isnan(rows["y"].get()).all()


@pytest.mark.parametrize(
    "has_watchdog, multiply_adds, launched",
    [
        (True, 0, [(None, (256,))]),
        (True, 100, [(None, (256,))]),
        (True, 101, [((0,), (128,)), ((128,), (128,))]),
        (True, 1e9, [((64 * i,), (64,)) for i in range(4)]),
        (False, 1e9, [(None, (256,))]),
    ],
)
def test_a_long_kernel_is_launched_in_parts_for_a_watchdog(
    program, rows, dev, monkeypatch, *, has_watchdog, multiply_adds, launched
):
    monkeypatch.setattr(device_module, "MOST_MULTIPLY_ADDS", 100)
    monkeypatch.setattr(dev, "has_watchdog", has_watchdog)
    ranges, flushed, enqueued, queue = [], [], getattr(cl, ENQUEUE), dev.queue

    class Watched:
        def flush(self):
            flushed.append(len(ranges))

    def enqueue(_, kernel, size, local, offset):
        ranges.append((offset, size))
        return enqueued(queue, kernel, size, local, offset)

    x = rows["x"].get()
    n = 200
    longer = np.resize(x, (n, 4))
    rows |= {"n": n, "x": dev.upload(longer), "y": dev.empty((n, 1))}
    with monkeypatch.context() as patch:
        patch.setattr(dev, "queue", Watched())
        patch.setattr(cl, ENQUEUE, enqueue)
        program.launch("rows", n, multiply_adds=multiply_adds, **rows)
    assert ranges == launched
    # each part is flushed on its own
    watched = has_watchdog and multiply_adds > 0
    assert flushed == (list(range(1, len(launched) + 1)) if watched else [])
    np.testing.assert_allclose(
        rows["y"].get()[:, 0], 2 * longer.sum(1) + np.arange(n) % 3, rtol=1e-6
    )


INT, UINT = np.zeros(3, np.int32), np.zeros(3, np.uint32)
# (changed arguments, None: left out; error; message)
REFUSED = [
    ({"scale": None}, TypeError, r"missing \['scale'\], unknown \[\]"),
    ({"z": 1}, TypeError, r"missing \[\], unknown \['z'\]"),
    ({"k": INT}, TypeError, "k is an array of int32, expected .*uint32"),
    ({"x": 1.0}, TypeError, "x is a float, expected a device array"),
    ({"n": UINT}, TypeError, "n = .*is no uint32"),
    ({"n": 33.0}, TypeError, "n = 33.0 is no uint32"),
    ({"n": -1}, TypeError, "n = -1 is no uint32"),
    ({"y": np.zeros(33, "f4")}, ValueError, r"y has shape \(33,\), expected rank 2"),
    ({"k": UINT.repeat(2)}, ValueError, r"k has shape \(6,\), expected \('3',\)"),
    ({"n": 32}, ValueError, r"x has shape \(33, 4\), expected .* with N = 32"),
    ({"y": np.zeros((32, 1), "f4")}, ValueError, "y has shape .* with N = 33"),
]


@pytest.mark.parametrize("change, error, message", REFUSED)
def test_refused_before_the_enqueue(program, dev, rows, monkeypatch, change, error, message):
    program.launch("rows", 33, **rows)  # a good launch before must not hide a bad one
    dev.fill(rows["y"], -1)
    enqueued = []
    monkeypatch.setattr(cl, ENQUEUE, lambda *args: enqueued.append(args))
    ((name, value),) = change.items()
    rows[name] = dev.upload(value) if isinstance(value, np.ndarray) else value
    if value is None:
        del rows[name]
    with pytest.raises(error, match=f"^toy.cl:rows: {message}"):
        program.launch("rows", 33, **rows)
    assert enqueued == []


def test_what_is_not_contiguous_is_refused(program, dev, rows):
    with pytest.raises(ValueError, match="x has shape .*not contiguous"):
        program.launch("rows", 33, **rows | {"x": dev.zeros((4, 33)).T})


FORMULAS = {"offsets": (34,), "halves": (3, 8), "both": (11,), "first": (5,), "second": (7,)}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"offsets": (33,)}, r"offsets has shape \(33,\), expected .* with N\+1 = 34"),
        ({"halves": (4, 8)}, r"halves .* with \(height-1\)/2 = 3"),
        ({"both": (12,)}, r"both .* with a \+ B - 1 = 11"),
    ],
)
def test_a_length_that_is_a_formula_is_checked(dev, tmp_path, monkeypatch, change, message):
    (tmp_path / "toy.cl").write_text(SOURCE)
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path)
    program = dev.program("toy", WIDTH=4)
    good = {name: dev.zeros(shape) for name, shape in FORMULAS.items()}
    program.launch("formulas", 1, n=33, height=8, **good)
    bad = {name: dev.zeros(shape) for name, shape in change.items()}
    with pytest.raises(ValueError, match=f"^toy.cl:formulas: {message}"):
        program.launch("formulas", 1, n=33, height=8, **{**good, **bad})


def test_a_work_group_larger_than_the_device_runs_is_one_line(program, dev, rows):
    kernel = program.kernels["rows"]
    limit, what = kernel.largest_group, cl.kernel_work_group_info.WORK_GROUP_SIZE
    assert limit == kernel._kernel.get_work_group_info(what, dev.device)
    program.launch("rows", 33, local=min(64, limit), **rows)
    with pytest.raises(
        UserError, match=rf"^toy.cl:rows: a work-group of {2 * limit} work-items, but .* {limit} "
    ):
        program.launch("rows", 33, local=2 * limit, **rows)


@pytest.mark.parametrize("n", [1, 33, 257])
def test_a_write_behind_a_buffer_is_caught(program, dev, n):
    y = dev.zeros((n,))
    program.launch("behind", 1, n=n, y=y)
    with pytest.raises(AssertionError, match=f"behind a buffer of {4 * n} bytes"):
        dev.check()


INFO, ADDRESS = cl.kernel_arg_info, cl.kernel_arg_address_qualifier
TYPES = {dtype: name for name, dtype in SCALARS.items()}


def driver_says(kernel, i):
    """(name, type, address space, pointer to const) of a parameter, from -cl-kernel-arg-info."""
    name, kind, space, qualifiers = (
        kernel.get_arg_info(i, what)
        for what in (INFO.NAME, INFO.TYPE_NAME, INFO.ADDRESS_QUALIFIER, INFO.TYPE_QUALIFIER)
    )
    const = bool(qualifiers & cl.kernel_arg_type_qualifier.CONST)
    # PoCL renames all built-in functions
    return name.removeprefix("_cl_"), kind, space, const and space == ADDRESS.GLOBAL


def launcher_says(p):
    kind = TYPES[p.dtype] + (str(p.width) if p.width > 1 else "") + ("*" if p.is_buffer else "")
    space = ADDRESS.GLOBAL if p.is_buffer else ADDRESS.PRIVATE
    return p.name, kind, space, p.const and p.is_buffer


@pytest.mark.parametrize("stem", STEMS)
def test_file_builds_alone_and_its_signatures_agree_with_the_driver(dev, stem):
    source = (KERNEL_FOLDER / f"{stem}.cl").read_text("utf-8")
    parsed = parse_signatures(source, f"cl/{stem}.cl")
    assert parsed, "no kernel that the launcher can read"
    # Intel's runtime has no parameter names for a program from pyopencl's cache; hence the parser,
    # and this build without the cache.
    options = ["-cl-std=CL1.2", "-cl-kernel-arg-info", "-I", str(KERNEL_FOLDER)]
    built = cl.Program(dev.context, source).build(options=options, cache_dir=False)
    assert set(built.kernel_names.split(";")) == set(parsed)
    for name, parameters in parsed.items():
        kernel = getattr(built, name)
        assert [driver_says(kernel, i) for i in range(kernel.num_args)] == [
            launcher_says(p) for p in parameters
        ], name


LIMITED = {64: [(64,), (16, 4), (16, 4, 1)], 7: [(4,), (2, 2), (2, 2, 1)], 1: [(1,), (1, 1)]}


@pytest.mark.parametrize("limit", LIMITED)
def test_a_default_work_group_fits_the_device(program, monkeypatch, limit):
    kernel = program.kernels["rows"]
    monkeypatch.setattr(kernel, "largest_group", limit)
    monkeypatch.setattr(kernel, "_ranges", {})
    for group in LIMITED[limit]:
        rounded, local = kernel.ranges(tuple(5 for _ in group), None)
        assert local == group
        assert rounded == tuple(-(-5 // side) * side for side in group)


@pytest.mark.parametrize("given", [None, (1, 16, 4)])
def test_work_groups_may_have_one_dimension_alone(program, monkeypatch, given):
    kernel = program.kernels["rows"]
    monkeypatch.setattr(kernel, "most_items", (1024, 1, 1))
    monkeypatch.setattr(kernel, "_ranges", {})
    assert kernel.ranges((5, 5, 5), given)[1] == ((16, 1, 1) if given is None else (1, 1, 1))


@pytest.mark.parametrize(
    "parameters, message",
    [
        ("    global float *x)  // no shape", "f.cl: f: buffer 'x' has no shape"),
        ("    global float *x, const uint n)  // (N)", "one parameter per line"),
        ("    const size_t n)", "cannot read parameter"),
        ("    float *x)  // (N)", "neither a global"),
        ("    global float *x)  // (N**2)", r"f.cl: f: x: 'N\*\*2' is no formula"),
        ("    global float *x)  // (len(N))", "is no formula"),
        ("    global float *x)  // ((N)", "no shape"),
    ],
)
def test_heads_that_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        parse_signatures(f"kernel void f(\n{parameters}\n{{}}", "f.cl")


@replayed
def scaled(program, place, x, scale, wrong=()):
    """Fill and launch by the length of `wrong`, on which a replayed function must not depend."""
    place.require({"y": ((33, 1), np.float32)})
    place.dev.fill(place.y, 7 if len(wrong) == 1 else -1)
    k = place.dev.constant([(0,), (0,), (0,)]).view(np.uint32).reshape(3)
    program.launch("rows", 65 if len(wrong) > 1 else 33, n=33, scale=scale, x=x, k=k, y=place.y)
    return [place.y]


def test_a_call_is_replayed_while_its_arguments_are_the_same(program, dev, rows, monkeypatch):
    b, x, called = Buffers(dev), rows["x"], []
    launch = program.__class__.launch
    monkeypatch.setattr(program.__class__, "launch", lambda *a, **n: called.append(launch(*a, **n)))
    monkeypatch.setattr(dev, "doubts", False)
    first = scaled(program, b, x, 2.0)
    expected = first[0].get()
    for _ in range(2):
        dev.fill(b.y, np.nan)
        assert scaled(program, b, x, 2.0) is first
        np.testing.assert_array_equal(b.y.get(), expected)
    assert len(called) == 1
    for again in ((x, 3.0), (x[:], 3.0)):
        scaled(program, b, *again)
    assert len(called) == 3
    np.testing.assert_allclose(b.y.get(), 1.5 * expected, rtol=1e-6)
    b.require({"y": ((34, 1), np.float32)})  # forgets calls that hold the old buffer
    assert not b.calls


@pytest.mark.parametrize("wrong", [[0], [0, 0]])
def test_a_function_that_depends_on_more_than_its_arguments_fails(program, dev, rows, wrong):
    b, changing = Buffers(dev), []
    scaled(program, b, rows["x"], 2.0, changing)
    scaled(program, b, rows["x"], 2.0, changing)
    changing += wrong
    with pytest.raises(AssertionError):
        scaled(program, b, rows["x"], 2.0, changing)


def test_none_is_null_where_the_signature_says_so(dev, tmp_path, monkeypatch):
    (tmp_path / "toy.cl").write_text(SOURCE)
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path)
    program, y = dev.program("toy", WIDTH=5), dev.zeros((33,), np.uint32)
    program.launch("is_null", 33, n=33, x=None, y=y)
    assert (y.get() == 1).all()
    program.launch("is_null", 33, n=33, x=dev.zeros((33,)), y=y)
    assert (y.get() == 0).all()
    with pytest.raises(TypeError, match="y is a NoneType, expected a device array"):
        program.launch("is_null", 33, n=33, x=None, y=None)
    with pytest.raises(ValueError, match=r"x has shape \(32,\), expected"):
        program.launch("is_null", 33, n=33, x=dev.zeros((32,)), y=y)
