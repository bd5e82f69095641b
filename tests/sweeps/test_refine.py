"""Boundary refinement: which points are chosen, and that they are those of the full grid."""

import itertools
import json
import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from small_study import ALPHA, LAMBDA, NOISE, listed_axis, rigid_study, small_study, spaced_axis

from jaxbl.config import read_config
from jaxbl.errors import InputError
from jaxbl.report.results import describe
from jaxbl.sweeps.engine import Engine, Layout
from jaxbl.sweeps.points import Points
from jaxbl.sweeps.programs import BACKENDS
from jaxbl.sweeps.refine import CellGrid, Criterion, refine_boundary
from jaxbl.sweeps.sweep import StudyResult, dry_run, open_study, sweep

pytestmark = pytest.mark.usefixtures("compiled_once")

# ---------------------------------------------------------------- geometry, on functions instead of runs


def trace_boundary(function, grid):
    """Simulated vertices as a mask of the fine grid, the function on all of it, and the sizes of the batches."""
    grid_axes = [np.linspace(0.0, 1.0, size) for size in grid.sizes]
    full = np.asarray(function(*np.meshgrid(*grid_axes, indexing="ij")))
    batches, requests = [], []

    def evaluate(vertices):
        assert (np.diff(vertices) > 0).all()
        batches.append(len(vertices))
        requests.append(vertices)
        return full.ravel()[vertices]

    vertices, values = refine_boundary(grid, evaluate, lambda a, b: a != b)
    evaluated = np.concatenate(requests)
    assert len(np.unique(evaluated)) == len(evaluated)
    np.testing.assert_array_equal(vertices, np.sort(evaluated))
    np.testing.assert_array_equal(values, full.ravel()[vertices])
    mask = np.zeros(full.size, bool)
    mask[vertices] = True
    return mask.reshape(full.shape), full, batches


def square_grid(n, depth, dimensions=2):
    return CellGrid([(n - 1 << depth) + 1] * dimensions, [True] * dimensions, depth)


def list_corner_values(values):
    """Corner values of every cell, (2^d, cells along each axis)."""
    ends = (slice(None, -1), slice(1, None))
    return np.array([values[corner] for corner in itertools.product(ends, repeat=values.ndim)])


def find_boundary_cells(full):
    """Cells whose corners disagree."""
    corner_values = list_corner_values(full)
    return (corner_values != corner_values[0]).any(axis=0)


def find_simulated_cells(mask):
    """Cells all of whose corners were simulated."""
    return list_corner_values(mask).all(axis=0)


def label_boundary_pieces(full):
    """Label of each cell at the boundary, -1 elsewhere: cells are joined by the edges that disagree and that they share."""
    shape, d = [size - 1 for size in full.shape], full.ndim
    cells = np.arange(np.prod(shape)).reshape(shape)
    links = []
    for axis in range(d):
        hot = np.diff(full.astype(float), axis=axis) != 0.0
        starts = np.argwhere(hot)
        other_axes = [a for a in range(d) if a != axis]
        around = []
        for offset in itertools.product((0, 1), repeat=d - 1):
            place = starts.copy()
            place[:, other_axes] -= np.array(offset, int)
            inside = ((place >= 0) & (place < shape)).all(axis=1)
            around.append(np.where(inside, cells[tuple(np.clip(place, 0, np.array(shape) - 1).T)], -1))
        for a, b in itertools.combinations(around, 2):
            both_inside = (a >= 0) & (b >= 0)
            links.append(np.stack([a[both_inside], b[both_inside]]))
    pairs = np.concatenate([np.zeros((2, 0), int), *links], axis=1)
    graph = coo_matrix((np.ones(pairs.shape[1]), tuple(pairs)), (cells.size, cells.size))
    labels = connected_components(graph, directed=False)[1].reshape(shape)
    return np.where(find_boundary_cells(full), labels, -1)


def assert_traced(mask, full, depth):
    """Every piece of the boundary that a coarse edge crosses an odd number of times is simulated whole; so is every piece
    of which any cell is."""
    labels, cells = label_boundary_pieces(full), find_simulated_cells(mask)
    touched = np.unique(labels[cells & (labels >= 0)])
    missed = np.isin(labels, touched) & (labels >= 0) & ~cells
    assert not missed.any()
    stride = 1 << depth
    coarse = full[(slice(None, None, stride),) * full.ndim]
    for axis in range(full.ndim):
        for start in np.argwhere(np.diff(coarse.astype(float), axis=axis) != 0.0) * stride:
            along = [slice(p, p + 1) for p in start]
            along[axis] = slice(start[axis], start[axis] + stride + 1)
            line = mask[tuple(along)].ravel() & True
            values = full[tuple(along)].ravel()
            # somewhere on a hot coarse edge two neighbours of the fine grid that disagree are both simulated
            assert (line[1:] & line[:-1] & (values[1:] != values[:-1])).any()


SHAPES = {
    "circle": (lambda x, y: (x - 0.5) ** 2 + (y - 0.4) ** 2 < 0.09, 17, 4),
    "straight along the grid": (lambda x, y: (x > 0.5) & (y > -1.0), 9, 5),
    "thin diagonal strip": (lambda x, y: abs(x + 0.3 * y - 0.6) < 0.004, 9, 6),
    "leaves its strip": (lambda x, y: y > 0.5 + 0.3 * np.sin(40.0 * x), 9, 6),
    "spiral": (lambda x, y: np.sin(40.0 * np.hypot(x - 0.5, y - 0.5) + np.arctan2(y - 0.5, x - 0.5)) > 0.97, 9, 5),
    "everything": (lambda x, y: (np.sin(1e4 * x) + np.sin(1e4 * y)) > 0.0, 5, 3),
    "one interval": (lambda x, y: y > 0.3 + x, 2, 7),
    "point in one dimension": (lambda x: x > 0.3, 5, 8),
    "comb in one dimension": (lambda x: np.sin(30.0 * x) > 0.0, 9, 6),
    "sphere": (lambda x, y, z: (x - 0.5) ** 2 + (y - 0.4) ** 2 + z**2 < 0.2, 5, 3),
    "thread": (lambda x, y, z: np.hypot(x - 0.3 * z - 0.31, y - 0.5 * z - 0.2) < 0.03, 5, 4),
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_boundary_is_traced_from_end_to_end(name):
    function, n, depth = SHAPES[name]
    grid = square_grid(n, depth, function.__code__.co_argcount)
    mask, full, _ = trace_boundary(function, grid)
    assert_traced(mask, full, depth)


@pytest.mark.parametrize("name", ["circle", "leaves its strip", "thin diagonal strip"])
def test_one_piece_is_found_whole(name):
    """If the coarse grid sees a piece at all, the study has every cell of the full grid's boundary."""
    function, n, depth = SHAPES[name]
    mask, full, _ = trace_boundary(function, square_grid(n, depth))
    assert not (find_boundary_cells(full) & ~find_simulated_cells(mask)).any()


def test_cost_of_a_circle_grows_with_its_length_not_with_its_area():
    circle = SHAPES["circle"][0]
    shares = []
    for depth in (3, 5, 6):
        mask, full, batches = trace_boundary(circle, square_grid(17, depth))
        shares.append(mask.sum() / find_boundary_cells(full).sum())
        assert len(batches) <= 2 * depth + 1
    # about two vertices for each cell of the boundary on the finest level, as many again on all others
    assert max(shares) < 5.0
    assert mask.mean() < 0.02


def test_nothing_is_added_where_all_agree():
    for dimensions in (1, 2, 3):
        grid = square_grid(5, 4, dimensions)
        mask, _, batches = trace_boundary(lambda x, *_: x < 2.0, grid)
        assert batches == [5**dimensions]
        np.testing.assert_array_equal(np.flatnonzero(mask), grid.coarse_indices(np.arange(math.prod(grid.coarse_sizes))))


def test_what_the_coarse_grid_does_not_see_stays_unseen():
    mask, _, batches = trace_boundary(lambda x, y: np.hypot(x - 0.51, y - 0.52) < 0.005, square_grid(5, 6))
    assert batches == [25]
    assert mask.sum() == 25


def test_axes_that_are_not_refined_have_a_grid_of_their_own():
    def crosses_shifted_edge(c, x, y, e):
        return (x + 0.2 * c + 0.0 * e > 0.5) & (y > 0.3)

    grid = CellGrid([3, 33, 65, 2], [False, True, True, False], 3)
    assert grid.coarse_sizes == (3, 5, 9, 2)
    mask, full, batches = trace_boundary(crosses_shifted_edge, grid)
    together = len(batches)
    for i, j in itertools.product(range(3), range(2)):
        part = full[i, :, :, j]
        alone, _, _ = trace_boundary(lambda *_, part=part: part, CellGrid([33, 65], [True, True], 3))
        np.testing.assert_array_equal(mask[i, :, :, j], alone)
    assert together <= 12


@st.composite
def cut_waves(draw):
    """A few waves on a grid of one to three dimensions, cut at a level."""
    dimensions = draw(st.integers(1, 3))
    n = draw(st.integers(2, 5))
    depth = draw(st.integers(1, {1: 6, 2: 4, 3: 2}[dimensions]))
    waves = draw(
        st.lists(
            st.tuples(st.lists(st.floats(-20.0, 20.0), min_size=dimensions, max_size=dimensions), st.floats(0.0, 6.3)),
            min_size=1,
            max_size=3,
        )
    )
    cut = draw(st.floats(-1.0, 1.0))

    def function(*places):
        return sum(np.sin(sum(k * x for k, x in zip(ks, places, strict=True)) + p) for ks, p in waves) > cut

    return function, square_grid(n, depth, dimensions), depth


@settings(max_examples=150, deadline=None)
@given(cut_waves())
def test_any_boundary_is_traced(case):
    function, grid, depth = case
    mask, full, _ = trace_boundary(function, grid)
    assert_traced(mask, full, depth)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 2))
def test_random_labels_are_traced(seed, dimensions):
    """No smoothness at all: boundaries everywhere, with every way of touching the edge of the grid."""
    rng = np.random.default_rng(seed)
    grid = square_grid(3, 3, dimensions)
    full = rng.random(grid.sizes) < rng.choice([0.02, 0.1, 0.5])
    mask, full, _ = trace_boundary(lambda *_: full, grid)
    assert_traced(mask, full, 3)


# ---------------------------------------------------------------- when neighbours disagree

NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("a", "b", "differ"),
    [
        (1.0, 1.0, False), (1.0, 1.09, False), (1.0, 1.2, True), (-1.0, 1.0, True), (0.0, 0.0, False), (0.0, 1e-9, True),
        (NAN, 1.0, True), (NAN, NAN, False), (INF, 1.0, True), (INF, INF, False), (INF, -INF, True), (INF, NAN, True),
    ],
)  # fmt: skip
def test_numbers_that_disagree(a, b, differ):
    criterion = Criterion.of(["motor.velocity_rmse"], 0.1)
    assert criterion.columns == ("motor.velocity_rmse", "finite")
    for first, second in ((a, b), (b, a)):
        ends = (np.array([[[1.0, 1.0], [value, 1.0]]]) for value in (first, second))
        assert criterion.disagree(*ends).tolist() == [differ]


def test_true_and_false_disagree_whatever_the_tolerance():
    criterion = Criterion.of(["motor.converged", "finite"], 5.0)
    assert criterion.columns == ("motor.converged", "finite")
    ends = np.array([[[1.0, 1.0]], [[0.0, 1.0]], [[0.0, 0.0]]])
    assert criterion.disagree(ends, ends[[0, 0, 1]]).tolist() == [False, True, True]


# ---------------------------------------------------------------- points

GAINS = [spaced_axis(LAMBDA, 0.5, 8.0, 5), spaced_axis(ALPHA, 1.0, 9.0, 3, "linear")]


def make_points(*axes, **sweep):
    return Points(read_config(small_study(axes=list(axes), sweep={"refine": 2, **sweep})))


def test_coarse_values_are_the_same_to_the_bit_with_and_without_refinement():
    for num, depth in ((33, 5), (7, 4), (2, 9)):
        axes = [spaced_axis(LAMBDA, 0.1, 37.0, num), spaced_axis(ALPHA, 0.3, 91.7, num, "linear")]
        plain, fine = (Points(read_config(small_study(axes=axes, sweep=s))) for s in ({}, {"refine": depth}))
        assert fine.coarse_size == plain.group_size
        coarse_points = np.arange(plain.group_size)
        expected = plain.columns(coarse_points)
        for path, values in fine.columns(fine.coarse_points(coarse_points)).items():
            np.testing.assert_array_equal(values, expected[path])
        # and all values are those of a grid that is as fine
        axes = [axis | {"num": (num - 1 << depth) + 1} for axis in axes]
        full_points = Points(read_config(small_study(axes=axes)))
        for path in (LAMBDA, ALPHA):
            np.testing.assert_array_equal(fine.axis_values(path), full_points.axis_values(path))


def test_what_is_refined():
    study = make_points(
        listed_axis(NOISE, 0.0, 1e-4),
        *GAINS,
        listed_axis("observer.load.alpha", 0.2, 0.4, zip="g"),
        spaced_axis("observer.load.lambda", 0.5, 1.0, 2, zip="g"),
        spaced_axis("run.substeps", 1, 2, 2, "linear"),
    )
    refinement = study.refinement
    assert refinement.paths == [LAMBDA, ALPHA]
    assert refinement.grid.sizes == (2, 17, 9, 2)
    assert (len(study.groups), study.group_size, study.coarse_size) == (2, 2 * 17 * 9 * 2, 2 * 5 * 3 * 2)
    assert refinement.criterion.columns == ("motor.converged", "finite")
    coarse = study.columns(study.coarse_points(np.arange(study.coarse_size)))
    assert study.on_coarse_grid(coarse).all()
    assert study.on_coarse_grid(study.columns(np.arange(study.group_size))).sum() == study.coarse_size


def test_what_is_compared():
    def columns(*axes, **sweep):
        return make_points(*axes, **sweep).refinement.criterion.columns

    load = spaced_axis("observer.load.alpha", 0.1, 1.0, 3)
    assert columns(load) == ("load.converged", "finite")
    assert columns(load, GAINS[0]) == ("motor.converged", "load.converged", "finite")
    assert columns(spaced_axis(NOISE, 1e-5, 1e-3, 3)) == ("motor.converged", "load.converged", "finite")
    assert columns(load, refine_metric="motor.chatter") == ("motor.chatter", "finite")
    refinement = make_points(load, refine_metric="motor.chatter", refine_tolerance=0.5).refinement
    assert refinement.criterion.tolerances == (0.5, 0.0)


BAD = {
    "zero": ({"refine": 0}, GAINS, "sweep.refine: should be greater than or equal to 1, not 0"),
    "metric alone": ({"refine_metric": "finite"}, GAINS, "sweep: refine_metric needs refine, the number of times"),
    "tolerance alone": ({"refine_tolerance": 0.1}, GAINS, "sweep: refine_tolerance needs refine"),
    "no tolerance": (
        {"refine": 1, "refine_metric": "motor.chatter", "refine_tolerance": 0.0},
        GAINS,
        "sweep.refine_tolerance: should be greater than 0, not 0.0",
    ),
    "tolerance of what is true or false": (
        {"refine": 1, "refine_metric": "motor.converged", "refine_tolerance": 0.1},
        GAINS,
        "sweep: refine_tolerance needs a numeric refine_metric, e.g. 'motor.velocity_rmse'",
    ),
    "tolerance of no metric": ({"refine": 1, "refine_tolerance": 0.1}, GAINS, "refine_tolerance needs a numeric"),
    "unknown metric": (
        {"refine": 1, "refine_metric": "motor.velocity_rms"},
        GAINS,
        "sweep.refine_metric: 'motor.velocity_rms' is no metric; did you mean 'motor.velocity_rmse'?",
    ),
    "metric that is not computed": (
        {"refine": 1, "refine_metric": "motor.chatter", "metrics": ["converged"]},
        GAINS,
        "sweep.refine_metric: 'motor.chatter' is not computed; add 'chatter' to sweep.metrics",
    ),
    "nothing to compare": ({"refine": 1, "metrics": ["chatter"]}, GAINS, "sweep.refine_metric is missing: neighbours are"),
    "no metrics": ({"metrics": []}, GAINS, "sweep: metrics should name at least one"),
    "a metric twice": ({"metrics": ["chatter", "chatter"]}, GAINS, "sweep: metrics names 'chatter' twice"),
    "design": (
        {"refine": 1, "design": "sobol", "points": 4},
        [spaced_axis(ALPHA, 1.0, 2.0)],
        "sweep: refine needs design = 'grid'; points of a sobol design have no neighbours",
    ),
    "listed values": (
        {"refine": 1},
        [listed_axis(ALPHA, 1.0, 2.0)],
        "sweep.refine: no axis can be refined; an axis is needed with start",
    ),
    "structural": ({"refine": 1}, [spaced_axis("run.substeps", 1, 2, 2, "linear")], "sweep.refine: no axis can be refined"),
    "zipped": (
        {"refine": 1},
        [spaced_axis(p, 1.0, 2.0, 3, zip="g") for p in (ALPHA, LAMBDA)],
        "sweep.refine: no axis can be",
    ),
    "no axes": ({"refine": 1}, [], "sweep.refine: no axis can be refined"),
    "too many values": (
        {"refine": 25},
        GAINS[:1],
        f"sweep.refine: 25 makes more than 1e+07 values of '{LAMBDA}'; it should be at most 21",
    ),
    "too many values as it is": (
        {"refine": 1},
        [spaced_axis(ALPHA, 1.0, 2.0, 9_000_000)],
        "it does not fit here: num is too large",
    ),
    "too many runs": (
        {"refine": 16, "seeds": 10},
        GAINS,
        "sweep.refine: 16 makes a fine grid of 3.4e+11 runs, more than 1e+10; it should be less",
    ),
    "first seed": ({"first_seed": -1}, GAINS, "sweep.first_seed: should be greater than or equal to 0, not -1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_that_names_the_key(case):
    table, axes, message = BAD[case]
    with pytest.raises(InputError) as error:
        Points(read_config(small_study(axes=axes, sweep=table)))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------- studies


def study(changes=None, refine=3, num=5, seeds=1, axes=None, **sweep_keys):
    """Explicit observer without noise: a boundary from weak alpha to chatter; 100 samples a run."""
    changes = {
        "observer.discretisation": "explicit", "run.duration": 0.1, "run.velocity_tolerance": 0.1, "encoders.noise": 0.0,
    } | (changes or {})  # fmt: skip
    axes = axes or [spaced_axis(LAMBDA, 0.5, 40.0, num), spaced_axis(ALPHA, 2.0, 200.0, num)]
    table = {"seeds": seeds, "chunk": 64, **({} if refine is None else {"refine": refine}), **sweep_keys}
    return rigid_study(changes, axes=axes, sweep=table)


def simulate_full_grid(data):
    """All points of the fine grid, by the engine that a refined study has."""
    engine = Engine(read_config(data), Layout(read_config(data).sweep.seeds, 2048))
    all_points = np.arange(engine.points.group_size)
    return pd.concat(
        [engine.run(chunk) for g in range(len(engine.points.groups)) for chunk in engine.split_points(g, all_points)],
        ignore_index=True,
    )


def assert_on_the_whole_grid(result, full_frame):
    """Every row of a refined study is, to the bit, the row of the whole grid."""
    keys = [*(axis.path for axis in result.config.axes), "seed"]
    frame = result.frame.sort_values(keys, ignore_index=True)
    assert not frame.duplicated(keys).any()
    actual = full_frame.merge(frame[keys], on=keys).sort_values(keys, ignore_index=True)
    exact = [name for name in frame if not name.endswith("convergence_time_bound")]  # rounds differently in other chunks
    pd.testing.assert_frame_equal(actual[exact], frame[exact], check_exact=True)


def grid_masks(data, frame, full_frame):
    """Simulated points and convergence on the whole grid, two axes."""
    config = Points(read_config(data))
    shape = config.refinement.grid.sizes
    rows = np.ravel_multi_index([np.searchsorted(config.axis_values(p), frame[p]) for p in config.paths], shape)
    mask = np.zeros(shape, bool)
    mask.ravel()[rows] = True
    return mask, full_frame.sort_values(config.paths)["motor.converged"].to_numpy().reshape(shape)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_the_boundary_of_the_full_grid_at_257(precision):
    changes = {"run.precision": precision, "observer.discretisation": "implicit", "run.velocity_tolerance": 0.05}
    axes = [spaced_axis(LAMBDA, 3.0, 40.0, 17), spaced_axis(ALPHA, 2.0, 200.0, 17)]  # where the boundary is one line
    # all metrics are compared on a smaller grid, below
    data = study(changes, refine=4, axes=axes, chunk=256, metrics=["converged", "velocity_rmse"])
    result, full_grid = sweep(data), simulate_full_grid(data)
    assert len(full_grid) == 257**2
    assert_on_the_whole_grid(result, full_grid)
    mask, full = grid_masks(data, result.frame, full_grid)
    assert_traced(mask, full, 4)
    boundary = find_boundary_cells(full)
    assert boundary.sum() > 250
    assert not (boundary & ~find_simulated_cells(mask)).any()
    assert mask.mean() < 0.06


def test_values_are_those_of_the_whole_grid_and_of_the_plain_study():
    data = study()
    result = sweep(data)
    assert 25 < len(result.frame) < 33**2
    assert_on_the_whole_grid(result, simulate_full_grid(data))
    # a study without refinement has the coarse points, to the bit
    plain = sweep(study(refine=None)).frame
    points = Points(result.config)
    coarse = result.frame[points.on_coarse_grid(result.frame)].reset_index(drop=True)
    exact = [name for name in plain if not name.endswith("convergence_time_bound")]
    keys = [LAMBDA, ALPHA]
    shared = coarse.merge(plain[keys], on=keys)
    pd.testing.assert_frame_equal(shared.sort_values(keys)[exact].reset_index(drop=True), plain[exact], check_exact=True)


@pytest.mark.parametrize(("chunk", "devices"), [(8, 1), (100, 2), (4096, 2)])
def test_the_same_points_and_numbers_on_any_chunks_and_devices(chunk, devices):
    import jax

    expected = sweep(study(seeds=2)).frame
    result = sweep(study(seeds=2, chunk=chunk), devices=jax.devices()[:devices])
    keys = [LAMBDA, ALPHA, "seed"]
    frames = [frame.sort_values(keys, ignore_index=True) for frame in (result.frame, expected)]
    exact = [name for name in expected if not name.endswith("convergence_time_bound")]
    pd.testing.assert_frame_equal(frames[0][exact], frames[1][exact], check_exact=True)


def test_every_point_has_all_seeds_and_one_that_disagrees_is_enough():
    data = study({"encoders.noise": 1e-4}, refine=2, seeds=3, first_seed=7)
    frame = sweep(data).frame
    assert sorted(frame["seed"].unique()) == [7, 8, 9]
    assert (frame.groupby([LAMBDA, ALPHA]).size() == 3).all()
    single_seed = sweep(study({"encoders.noise": 1e-4}, refine=2, seeds=1, first_seed=8)).frame
    keys = [LAMBDA, ALPHA]
    assert set(map(tuple, single_seed[keys].to_numpy())) < set(map(tuple, frame[keys].to_numpy()))
    shared = frame[frame["seed"] == 8].merge(single_seed[keys], on=keys)
    assert shared["motor.velocity_rmse"].sum() == pytest.approx(single_seed["motor.velocity_rmse"].sum(), rel=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_first_seed_shifts_the_noise(backend):
    axes = [listed_axis(ALPHA, 5.0, 9.0)]
    four_seeds = sweep(rigid_study(axes=axes, sweep={"seeds": 4}), backend=backend).frame
    last_seeds = sweep(rigid_study(axes=axes, sweep={"seeds": 2, "first_seed": 2}), backend=backend).frame
    exact = [name for name in four_seeds if not name.endswith("convergence_time_bound")]
    pd.testing.assert_frame_equal(
        four_seeds[four_seeds["seed"] >= 2].reset_index(drop=True)[exact], last_seeds[exact], check_exact=True
    )


def test_a_number_as_metric_and_one_axis():
    axes = [spaced_axis(ALPHA, 2.0, 200.0, 5)]
    coarse, fine = (
        sweep(study(axes=axes, refine=5, refine_metric="motor.velocity_rmse", refine_tolerance=t)).frame for t in (0.5, 0.05)
    )
    assert 5 < len(coarse) < len(fine) <= 129
    ordered = fine.sort_values(ALPHA)
    value, place = ordered["motor.velocity_rmse"].to_numpy(), ordered[ALPHA].to_numpy()
    far = np.abs(np.diff(value)) > 0.05 * np.maximum(value[1:], value[:-1])
    # neighbours disagree only where nothing lies between them
    assert (np.diff(np.log(place))[far] < 1.01 * np.log(100.0) / 128).all()


def test_groups_and_listed_axes_are_refined_each_by_itself():
    structure = listed_axis("run.sample_period", 1e-3, 2e-3)
    noise = listed_axis(NOISE, 0.0, 1e-4)
    data = study(refine=2, axes=[structure, *study()["axes"], noise])
    result = sweep(data)
    for period in (1e-3, 2e-3):
        single_frame = sweep(study({"run.sample_period": period}, refine=2, axes=[*study()["axes"], noise])).frame
        part = result.frame[result.frame["run.sample_period"] == period].reset_index(drop=True)
        exact = [name for name in single_frame if not name.endswith("convergence_time_bound")]
        pd.testing.assert_frame_equal(part[exact], single_frame[exact], check_exact=True)
    counts = result.frame.groupby(["run.sample_period", NOISE]).size()
    assert (counts > 25).all() and counts.nunique() > 1


# ---------------------------------------------------------------- folders


@pytest.fixture(scope="module")
def refined_study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("refined") / "study"
    return folder, sweep(study(), folder)


def read_files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def read_manifest(folder):
    return json.loads((folder / "manifest.json").read_text())["results"]["sweep"]


def count_parts(folder):
    return len(list(folder.glob("points/part-*.parquet")))


def test_a_refined_study_in_a_folder(refined_study, computed_chunks):
    folder, result = refined_study
    assert read_manifest(folder)["finished"]
    assert read_manifest(folder)["rows"] == len(result.frame)
    assert read_manifest(folder)["parts"] == count_parts(folder) > 3
    pd.testing.assert_frame_equal(open_study(folder).frame, result.frame)
    pd.testing.assert_frame_equal(sweep(study()).frame, result.frame)
    computed_chunks.clear()
    before = read_files(folder)
    second = sweep(study(), folder)
    assert (computed_chunks, second.cost["lanes"]) == ([], 0)
    assert read_files(folder) == before
    found = describe(open_study(folder))
    share = f"{100 * len(result.frame) / 33**2:.0f}"
    count = len(result.frame)
    assert found.headline.startswith(f"{count} runs at {count} of 1089 grid points ({share} %): ")
    # its gains have little reserve
    assert found.verdict == "doubtful" and "Little reserve" in found.headline
    assert "not finished" not in "".join(found.sentences)


@pytest.mark.parametrize("stop", [0, 1, 3, 5])
def test_an_interrupted_study_replays_its_decisions_and_computes_nothing_twice(
    tmp_path, refined_study, computed_chunks, stop
):
    calls = []

    def interrupt(done, total):
        calls.append((done, total))
        if len(calls) == stop + 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(study(), tmp_path / "study", progress=interrupt)
    # the next one may have been computed while that was written
    assert computed_chunks in (list(range(stop + 1)), list(range(stop + 2)))
    assert not read_manifest(tmp_path / "study")["finished"]
    unfinished = open_study(tmp_path / "study")
    runs = sum(map(len, unfinished.batches(["seed"])))
    assert describe(unfinished).remarks[0].startswith(f"The study is not finished: {runs} runs so far")
    calls.clear()
    # with other chunks asked for: those of the folder stay
    result = sweep(study(chunk=4096), tmp_path / "study", progress=lambda *done: calls.append(done))
    pd.testing.assert_frame_equal(result.frame, refined_study[1].frame)
    assert computed_chunks == list(range(count_parts(refined_study[0])))
    dones, totals = zip(*calls, strict=True)
    assert dones[-1] == totals[-1] == len(result.frame)
    assert list(totals) == sorted(totals) and all(d <= t for d, t in calls)
    expected = {key: read_manifest(refined_study[0])[key] for key in ("parts", "rows", "finished")}
    assert {key: read_manifest(tmp_path / "study")[key] for key in expected} == expected


@pytest.mark.parametrize("damage", ["truncated", "missing", "other rows", "one too many"])
def test_a_part_that_is_not_right_is_computed_again(tmp_path, refined_study, computed_chunks, damage):
    folder = tmp_path / "study"
    for name, content in read_files(refined_study[0]).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    part = folder / "points" / "part-00002.parquet"
    if damage == "truncated":
        part.write_bytes(part.read_bytes()[:-2000])
    elif damage == "missing":
        part.unlink()
    elif damage == "other rows":
        part.write_bytes((folder / "points" / "part-00001.parquet").read_bytes())
    else:
        (folder / "points" / f"part-{count_parts(folder):05d}.parquet").write_bytes(part.read_bytes())
    result = sweep(study(), folder)
    assert computed_chunks == ([] if damage == "one too many" else [2])
    pd.testing.assert_frame_equal(result.frame, refined_study[1].frame)


def test_dry_run_knows_the_coarse_grid():
    cost = dry_run(study(seeds=2))
    assert (cost.points, cost.rows, cost.max_points) == (25, 50, 1089)


def test_as_a_dataset(refined_study):
    pytest.importorskip("xarray")
    frame = refined_study[1].frame
    dataset = refined_study[1].to_xarray()
    assert dict(dataset.sizes) == {LAMBDA: frame[LAMBDA].nunique(), ALPHA: frame[ALPHA].nunique(), "seed": 1}
    converged = dataset["motor.converged"]
    assert converged.dtype == float
    assert int(converged.notnull().sum()) == len(frame)
    assert converged.sum() == frame["motor.converged"].sum()
    row = frame.iloc[-1]
    value = dataset["motor.velocity_rmse"].sel({LAMBDA: row[LAMBDA], ALPHA: row[ALPHA], "seed": 0})
    assert value == row["motor.velocity_rmse"]


def test_a_dataset_that_would_be_mostly_empty_and_large():
    config = read_config(study(refine=12))
    values = Points(config).axis_values(ALPHA)
    frame = pd.DataFrame({LAMBDA: values[:9000], ALPHA: values[:9000], "seed": 0, "motor.velocity_rmse": 1.0})
    with pytest.raises(ValueError, match="most of them NaN; use the frame"):
        StudyResult(config, frame).to_xarray()
