"""The checkpoint pair: what goes in comes out, and what is damaged is never taken for good."""

import errno
import json
import os
import zlib

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import CheckpointError, DiskFullError
from splatwizard_core.training.checkpoint import (
    Checkpoint,
    CheckpointStore,
    DamagedCheckpointError,
    differences,
    join_tensors,
    read_checkpoint,
    split_tensors,
)


def make(step=100, stage=0, *, finished=False, **changes):
    state = {
        "model": {"means": torch.arange(6.0).view(2, 3) + step, "empty": torch.zeros(2, 0, 3)},
        "extra": {"phase": "entropy", "degree": 2, "flag": True, "none": None, "rate": 0.1},
        "optimizer": {"moments": {"means": {"exp_avg": torch.ones(2, 3), "step": step}}},
        "rng": [torch.tensor([1, 2, 3], dtype=torch.uint8), 5],
    }
    values = {
        "stage": stage, "stage_name": f"s{stage}", "step": step, "finished": finished,
        "identity": {"method": "toy", "config": {"iterations": 200}}, "plan": ["pre | a | 1 | priority 0"],
        "extent": 1.5, "progress": {"steps": step}, "state": state,
    }  # fmt: skip
    return Checkpoint(**{**values, **changes})


def same(a, b):
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b) and a.dtype == b.dtype
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b and type(a) is type(b)


def test_what_is_written_is_read(tmp_path):
    path = CheckpointStore(tmp_path).write(make())
    assert path.name == "00-0000100.json"
    assert {p.name for p in tmp_path.iterdir()} == {"00-0000100.json", "00-0000100.safetensors"}
    found, expected = read_checkpoint(path), make()
    for name in ("stage", "stage_name", "step", "finished", "identity", "plan", "extent", "progress", "state"):
        assert same(getattr(found, name), getattr(expected, name)), name


leaves = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**60), 2**60), st.floats(allow_nan=False), st.text(max_size=5),
    st.sampled_from([torch.float32, torch.float64, torch.int64, torch.uint8, torch.bool]).flatmap(
        lambda dtype: st.lists(st.integers(0, 4), max_size=3).map(lambda shape: torch.ones(shape, dtype=dtype))
    ),
)  # fmt: skip
keys = st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=4)
states = st.dictionaries(
    keys, st.recursive(leaves, lambda s: st.lists(s, max_size=3) | st.dictionaries(keys, s, max_size=3), max_leaves=8)
)


@given(states)
def test_splitting_and_joining_are_inverse(state):
    tensors = {}
    plain = json.loads(json.dumps(split_tensors(state, tensors)))
    assert same(join_tensors(plain, tensors), state)


def test_tied_weights_and_views_are_stored(tmp_path):
    base = torch.arange(12.0)
    state = {"a": base, "b": base, "c": base[3:6], "d": base.view(3, 4).T}
    found = read_checkpoint(CheckpointStore(tmp_path).write(make(state=state)))
    assert same(found.state, {k: v.clone() for k, v in state.items()})


@pytest.mark.parametrize(
    "state", [{"a": object()}, {"a": {1: 2}}, {"$tensor": 1}, {"a": {"$tensor": "x"}}, {"a": {3, 4}}, {"a": b"x"}]
)
def test_what_would_come_back_as_something_else_is_refused(state):
    with pytest.raises(TypeError, match="checkpoint state at"):
        split_tensors(state, {})


def test_steps_of_eight_digits_are_found_and_pruned(tmp_path):
    store = CheckpointStore(tmp_path)
    for step in (9_999_999, 10_000_000, 10_000_001):
        store.write(make(step))
        assert store.restored(lambda found: found).step == step
        assert len(list(tmp_path.iterdir())) == 2


def test_a_failed_write_leaves_the_old_one_and_no_rest(tmp_path, monkeypatch):
    store = CheckpointStore(tmp_path)
    store.write(make(100))
    before = {p.name for p in tmp_path.iterdir()}

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        store.write(make(200))
    assert {p.name for p in tmp_path.iterdir()} == before
    assert store.restored(lambda found: found).step == 100


@pytest.mark.parametrize("failing", [1, 2])
def test_a_disk_that_is_full_leaves_no_tensors_without_their_checkpoint(tmp_path, monkeypatch, failing):
    """Of the two files, whichever meets it."""
    store, replace, calls = CheckpointStore(tmp_path), os.replace, []

    def full(source, target):
        calls.append(target)
        if len(calls) == failing:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(DiskFullError, match="bytes wanted"):
        store.write(make(200))
    assert list(tmp_path.iterdir()) == []


def test_a_step_that_is_written_again_is_whole_at_every_moment(tmp_path, monkeypatch):
    store, replace = CheckpointStore(tmp_path), os.replace
    store.write(make(100))
    seen = []

    def look(source, target):
        seen.append(read_checkpoint(tmp_path / "00-0000100.json").finished)
        replace(source, target)
        seen.append(read_checkpoint(tmp_path / "00-0000100.json").finished)

    monkeypatch.setattr(os, "replace", look)
    store.write(make(100, finished=True))
    assert seen == [False, False, False, True]
    assert len(list(tmp_path.iterdir())) == 2, "the tensors before are gone"
    store.write(make(200))
    assert {p.name for p in tmp_path.iterdir()} == {"00-0000200.json", "00-0000200.safetensors"}


def test_a_checkpoint_names_no_file_elsewhere(tmp_path):
    path = CheckpointStore(tmp_path).write(make())
    content = json.loads(path.read_text())["content"] | {"file": "../00-0000100.safetensors"}
    path.write_text(json.dumps({"crc": zlib.crc32(json.dumps(content).encode()), "content": content}))
    with pytest.raises(DamagedCheckpointError, match="names no file of tensors"):
        read_checkpoint(path)


def test_a_checkpoint_of_before_that_names_no_file_is_read(tmp_path):
    path = CheckpointStore(tmp_path).write(make())
    content = json.loads(path.read_text())["content"]
    del content["file"]
    path.write_text(json.dumps({"crc": zlib.crc32(json.dumps(content).encode()), "content": content}))
    assert same(read_checkpoint(path).state, make().state)


def test_the_identity_of_the_newest_is_read_without_its_tensors(tmp_path):
    store = CheckpointStore(tmp_path, keep=2)
    assert store.identity() is None
    store.write(make(100, identity={"method": "old"}))
    store.write(make(200))
    (tmp_path / "00-0000200.safetensors").unlink()
    assert store.identity() == {"method": "toy", "config": {"iterations": 200}}
    (tmp_path / "00-0000200.json").write_text("{")
    assert store.identity() is None


def test_only_the_newest_stay(tmp_path):
    store = CheckpointStore(tmp_path, keep=2)
    for step in (100, 200, 300, 1000):
        store.write(make(step))
    assert [p.name for p in store.paths()] == ["00-0001000.json", "00-0000300.json"]
    assert len(list(tmp_path.iterdir())) == 4


def test_the_last_of_each_earlier_stage_stays(tmp_path):
    store = CheckpointStore(tmp_path, keep=1)
    store.write(make(100))
    store.write(make(200, finished=True))
    store.write(make(10, stage=1))
    store.write(make(20, stage=1))
    assert [p.name for p in store.paths()] == ["01-0000020.json", "00-0000200.json"]
    assert store.last_of(0).step == 200
    with pytest.raises(CheckpointError, match="last checkpoint of stage 1 is missing"):
        store.last_of(1)


def test_what_a_killed_writer_left_is_removed_with_the_next_checkpoint(tmp_path):
    store = CheckpointStore(tmp_path)
    half = [f".00-0000050.{suffix}.{os.getpid()}-0123abcd.tmp" for suffix in ("json", "safetensors")]
    for name in (*half, "00-0000050.safetensors"):
        (tmp_path / name).write_text("half")
    (tmp_path / "00-0000040.json.damaged").write_text("kept for the curious")
    store.write(make())
    assert {p.name for p in tmp_path.iterdir()} == {
        "00-0000100.json", "00-0000100.safetensors", "00-0000040.json.damaged",
    }  # fmt: skip


def test_other_files_are_left_alone(tmp_path):
    other = tmp_path / "notes.json"
    other.write_text("{}")
    store = CheckpointStore(tmp_path)
    store.write(make())
    store.clear()
    assert list(tmp_path.iterdir()) == [other]
    assert store.restored(lambda found: found) is None


def test_an_empty_or_missing_directory_has_none(tmp_path):
    assert CheckpointStore(tmp_path).restored(lambda found: found) is None
    assert CheckpointStore(tmp_path / "missing").restored(lambda found: found) is None


def test_a_tensor_file_without_its_json_is_not_a_checkpoint(tmp_path):
    store = CheckpointStore(tmp_path, keep=2)
    store.write(make(100))
    newer = store.write(make(200))
    newer.unlink()
    assert store.restored(lambda found: found).step == 100


def flip(path, position):
    data = bytearray(path.read_bytes())
    data[position % len(data)] ^= 0x10
    path.write_bytes(data)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_flipped_bit_is_noticed(tmp_path_factory, data):
    directory = tmp_path_factory.mktemp("flip")
    path = CheckpointStore(directory).write(make())
    target = path if data.draw(st.booleans()) else path.with_suffix(".safetensors")
    flip(target, data.draw(st.integers(0, 10**6)))  # modulo the size, which the decimal checksums vary
    try:
        found = read_checkpoint(path)
    except CheckpointError:
        return
    # Padding, or white space of the header: nothing that is read has changed.
    assert same(found.state, make().state)
    assert found.step == 100


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
@pytest.mark.parametrize("length", [0, 1, 7, 50, -1])
def test_a_truncated_file_is_damaged(tmp_path, suffix, length):
    path = CheckpointStore(tmp_path).write(make())
    target = path.with_suffix(suffix)
    target.write_bytes(target.read_bytes()[:length])
    with pytest.raises(DamagedCheckpointError):
        read_checkpoint(path)


@pytest.mark.parametrize("text", ["[]", "{}", "null", '{"crc": 0, "content": {}}', "\xff", '{"content": 3, "crc": 1}'])
def test_json_of_another_shape_is_damaged(tmp_path, text):
    path = CheckpointStore(tmp_path).write(make())
    path.write_text(text, encoding="latin-1")
    with pytest.raises(DamagedCheckpointError):
        read_checkpoint(path)


def test_a_pair_that_does_not_belong_together_is_noticed(tmp_path):
    a = CheckpointStore(tmp_path / "a").write(make())
    b = CheckpointStore(tmp_path / "b").write(make())
    os.replace(b.with_suffix(".safetensors"), a.with_suffix(".safetensors"))
    with pytest.raises(DamagedCheckpointError, match="do not belong together"):
        read_checkpoint(a)


def test_a_missing_half_is_damaged(tmp_path):
    path = CheckpointStore(tmp_path).write(make())
    path.with_suffix(".safetensors").unlink()
    with pytest.raises(DamagedCheckpointError):
        read_checkpoint(path)


def test_another_format_is_refused_but_not_taken_for_damage(tmp_path, monkeypatch):
    from splatwizard_core.training import checkpoint

    monkeypatch.setattr(checkpoint, "FORMAT", 2)
    path = CheckpointStore(tmp_path).write(make())
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match="format 2, this version reads 1") as info:
        read_checkpoint(path)
    assert not isinstance(info.value, DamagedCheckpointError)


def test_the_one_before_a_damaged_one_is_taken(tmp_path, caplog):
    store = CheckpointStore(tmp_path, keep=3)
    for step in (100, 200, 300):
        store.write(make(step))
    flip(tmp_path / "00-0000300.safetensors", -1)
    flip(tmp_path / "00-0000200.json", 40)
    assert store.restored(lambda found: found).step == 100
    assert "tensor" in caplog.text
    assert "resuming from 00-0000100.json instead" in caplog.text
    # Set aside, so that it neither counts as newest again nor pushes out a good one.
    assert [p.name for p in store.paths()] == ["00-0000100.json"]
    assert (tmp_path / "00-0000300.safetensors.damaged").exists()


def test_nothing_but_damage_is_an_error(tmp_path):
    store = CheckpointStore(tmp_path)
    store.write(make())
    flip(tmp_path / "00-0000100.safetensors", -1)
    with pytest.raises(CheckpointError, match="no earlier checkpoint is left"):
        store.restored(lambda found: found)


def test_differences_name_keys_tasks_and_extent():
    old = make()
    assert differences(old, {"method": "toy", "config": {"iterations": 200}}, old.plan, 1.5) == []
    new = {"method": "toy", "config": {"iterations": 300, "lr": 0.1}}
    plan = ["pre | a | 2 | priority 0"]
    assert differences(old, new, plan, 2.0) == [
        "config.iterations: 200 -> 300",
        "config.lr: absent -> 0.1",
        "scene extent: 1.5 -> 2",
        "plan - pre | a | 1 | priority 0",
        "plan + pre | a | 2 | priority 0",
    ]


def test_long_values_are_cut_in_the_message():
    old = make(identity={"key": "a" * 64})
    assert differences(old, {"key": "b" * 64}, old.plan, 1.5) == [f"key: {'a' * 37}... -> {'b' * 37}..."]


def test_tuples_and_paths_of_an_identity_do_not_count_as_changes(tmp_path):
    old = make(identity={"sizes": [1, 2], "path": str(tmp_path)})
    assert differences(old, {"path": tmp_path, "sizes": (1, 2)}, old.plan, 1.5) == []


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "0"}, {"step": None}, {"step": -1}, {"finished": 1}, {"plan": {}}, {"progress": []},
        {"identity": None}, {"extent": "x"}, {"state": 7},
    ],
)  # fmt: skip
def test_a_field_of_another_type_falls_back_to_the_checkpoint_before(change, tmp_path):
    store = CheckpointStore(tmp_path, keep=2)
    for step in (100, 200):
        path = store.write(make(step=step))
    content = json.loads(path.read_text())["content"] | change
    path.write_text(json.dumps({"crc": zlib.crc32(json.dumps(content).encode()), "content": content}))

    def use(found):
        if not isinstance(found.state, dict):
            raise DamagedCheckpointError("no state")
        return found.step

    assert store.restored(use) == 100
    assert path.with_name(f"{path.name}.damaged").exists()
