import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_codecs.positions import morton
from sw_wisp import octree
from sw_wisp.nested import Counter, Reader, Writer
from sw_wisp.octree import Cells
from sw_wisp.octree_contexts import Shares


def ordered(levels, codes) -> Cells:
    cells = Cells(np.asarray(levels, np.int64), np.asarray(codes, np.int64))
    return cells.part(np.lexsort((cells.levels, cells.finest)))


def surface(n: int, levels, seed: int = 0) -> Cells:
    """Splats on a wavy sheet, at levels drawn from `levels`."""
    rng = np.random.default_rng(seed)
    points = rng.random((n, 3))
    points[:, 2] = 0.5 + 0.2 * np.sin(6 * points[:, 0]) * points[:, 1]
    level = rng.choice(np.asarray(levels), n)
    codes = morton.encode((points * 2.0**18).astype(np.int64))
    level = octree.spread_crowds(level, codes, rng.random(n))
    return ordered(level, codes >> (3 * (18 - level)))


def coded(subsets: list[Cells]) -> tuple[bytes, list[bytes]]:
    shares, files = octree.fit_shares(subsets), []
    for number, subset in enumerate(subsets):
        writer = Writer()
        octree.code_cells(writer, shares, len(subset), octree.joined(subsets[:number]), subset)
        files.append(writer.finish())
    return shares.pack(), files


def decoded(packed: bytes, files: list[bytes], sizes: list[int]) -> list[Cells]:
    byte_reader = ByteReader(packed)
    shares, found = Shares.unpack(byte_reader), []
    byte_reader.finish()
    for data, rows in zip(files, sizes, strict=True):
        reader = Reader(data)
        found.append(octree.code_cells(reader, shares, rows, octree.joined(found), None))
        reader.finish()
    return found


def same(a: Cells, b: Cells) -> bool:
    return np.array_equal(a.levels, b.levels) and np.array_equal(a.codes, b.codes)


CLOUDS = {
    "surface": surface(4000, [7, 8, 9, 10]),
    "random": ordered(np.full(500, 18), np.random.default_rng(1).integers(0, 8**18, 500)),
    "one at level 3": ordered([3], [77]),
    "one at level 18": ordered([18], [8**18 - 1]),
    "one level": surface(1000, [9]),
    "levels 3 and 18": ordered(np.repeat([3, 18], 40), [*range(40), *range(40)]),
    "leaf and inner node in one cell": ordered([5, 5, 6, 9], [100, 100, 801, 801 << 9]),
    "16 in a cell": ordered([6] * 16 + [18] * 16 + [6, 6], [5] * 16 + [8**18 - 1] * 16 + [9, 9]),
    "none": ordered([], []),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_cells_return(name):
    cloud = CLOUDS[name]
    (again,) = decoded(*coded([cloud]), [len(cloud)])
    assert same(again, cloud)


@pytest.mark.parametrize("name", CLOUDS)
def test_subsets_together_are_the_set(name):
    cloud = CLOUDS[name]
    label = np.random.default_rng(3).choice(4, len(cloud), p=[0.12, 0.18, 0.28, 0.42])
    subsets = [cloud.part(label == j) for j in (0, 1)] + [cloud.part(label == 9)] + [cloud.part(label > 1)]
    packed, files = coded(subsets)
    assert files[2] == b""
    again = decoded(packed, files, [len(each) for each in subsets])
    assert all(map(same, again, subsets))


@settings(max_examples=20)
@given(st.lists(st.tuples(st.integers(3, 18), st.integers(0, 40)), max_size=60))
def test_any_cells_return(pairs):
    cells = ordered([level for level, _ in pairs], [code * 8 ** (level - 3) // 7 for level, code in pairs])
    _, counts = np.unique(np.stack([cells.levels, cells.codes]), axis=1, return_counts=True)
    if counts.max(initial=0) <= octree.MOST_IN_A_CELL:
        assert same(decoded(*coded([cells]), [len(cells)])[0], cells)


def test_earlier_subsets_make_their_neighbours_cheaper():
    first, second = surface(4000, [9], seed=1), surface(4000, [9], seed=2)
    _, alone = coded([second])
    _, files = coded([first, second])
    assert len(files[1]) < 0.97 * len(alone[0])


def test_bits_of_splats_sum_to_the_bytes():
    cloud = surface(3000, [7, 8, 9])
    shuffled = np.random.default_rng(0).permutation(len(cloud))
    spent = octree.position_bits(cloud.part(shuffled))
    _, (data,) = coded([cloud])
    assert spent.sum() == pytest.approx(8 * len(data), rel=0.002)
    assert spent.min() > 0
    by_level = [spent[cloud.levels[shuffled] == level].mean() for level in (7, 8, 9)]
    assert by_level == sorted(by_level)


def test_a_counter_counts_what_a_writer_writes():
    cloud = surface(3000, [7, 8, 9])
    counter = Counter()
    octree.code_cells(counter, octree.fit_shares([cloud]), len(cloud), octree.joined([]), cloud)
    assert counter.total == pytest.approx(8 * len(coded([cloud])[1][0]), rel=0.002)


@pytest.mark.parametrize("claimed", [-1, 1, 10_000_000])
def test_another_number_of_rows_is_refused(claimed):
    cloud = CLOUDS["surface"]
    packed, (data,) = coded([cloud])
    with pytest.raises(BitstreamError):
        decoded(packed, [data], [len(cloud) + claimed])


def test_noise_is_refused_before_memory_is_taken():
    packed, _ = coded([CLOUDS["surface"]])
    rng = np.random.default_rng(0)
    for _ in range(20):
        with pytest.raises(BitstreamError):
            decoded(packed, [rng.integers(0, 256, 4000, np.uint8).tobytes()], [2000])


def test_a_probability_of_zero_is_refused():
    packed, _ = coded([CLOUDS["surface"]])
    with pytest.raises(BitstreamError, match="0"):
        Shares.unpack(ByteReader(packed[:3] + bytes(len(packed) - 3)))
    with pytest.raises(BitstreamError, match="levels"):
        Shares.unpack(ByteReader(b"\x05\x04" + packed[2:]))


def test_crowds_go_deeper_and_the_most_opaque_stay():
    codes = np.full(40, 8**18 - 1)
    opacities = np.arange(40)
    levels = octree.spread_crowds(np.full(40, 7), codes, opacities)
    assert (levels[opacities >= 24] == 7).all()
    assert sorted(np.bincount(levels)[7:10].tolist()) == [8, 16, 16]


def test_crowds_at_the_deepest_level_go_up_and_end_somewhere():
    codes = np.zeros(256, np.int64)
    levels = octree.spread_crowds(np.full(256, 18), codes, np.arange(256))
    assert np.array_equal(np.bincount(levels, minlength=19)[3:], np.full(16, 16))
    with pytest.raises(ValueError, match="merge"):
        octree.spread_crowds(np.full(257, 18), np.zeros(257, np.int64), np.arange(257))


def test_rows_stand_in_morton_order_coarse_first_and_opaque_first():
    levels, places = np.array([4, 3, 4, 4]), np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0]])
    assert octree.file_order(levels, places, np.array([0.1, 0.5, 0.9, 0.7])).tolist() == [1, 3, 0, 2]


def test_contexts_count_what_is_coded_around_a_child():
    rng = np.random.default_rng(0)
    nodes = np.unique(rng.integers(0, 8**3, 150))
    around, places = octree.Around(nodes, 3), morton.decode(nodes)
    truth = rng.random((len(nodes), 8)) < 0.4
    occupied = {tuple(2 * places[i] + morton.decode(np.array([c]))[0]) for i, c in np.argwhere(truth).tolist()}
    there = {tuple(place) for place in places.tolist()}
    for child in range(8):
        found = around.contexts(child, np.full(len(nodes), 2))
        corner = morton.decode(np.array([child]))[0]
        for row, place in enumerate(places):
            known = near = 0
            for axis in range(3):
                one = np.eye(3, dtype=int)[axis]
                if corner[axis]:
                    known += sum(tuple(2 * place + corner + side * one) in occupied for side in (-1, 1))
                else:
                    near += tuple(place - one) in there
            far = int(corner.sum())
            wanted = 120 + [0, 8, 26, 46][far] + 2 * (known * (4 - far) + near) + truth[row, :child].any()
            assert found[row] == wanted
        around.bits[:, child] = truth[:, child]


def test_splats_on_a_surface_cost_less_than_their_children_alone_tell():
    """The bits of children by how many came before, and by those of the parent, cost 9 % more."""
    cloud = surface(20_000, [8, 9])
    packed, (data,) = coded([cloud])
    assert 8 * (len(packed) + len(data)) < 8.2 * len(cloud)
