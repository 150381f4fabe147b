"""Files are written whole or not at all, whatever fails and wherever; a cache holds its keys."""

import multiprocessing
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from bfsensor.diagnose.data.channels import Channel
from bfsensor.errors import BFSensorError, SweepError, TableError
from bfsensor.files import Cache, held, refuse_existing, written_whole
from bfsensor.table.build import _level_name


def test_the_old_file_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with written_whole(path, TableError) as beside:
        beside.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("fault", "raised", "message"),
    [
        (OSError("disk full"), SweepError, r"a\.txt: cannot be written: disk full"),
        (ValueError("no number"), ValueError, "^no number$"),
        (TableError("odd"), TableError, "^odd$"),
        (KeyboardInterrupt("Ctrl-C"), KeyboardInterrupt, "Ctrl-C"),
    ],
)
def test_a_failure_leaves_nothing_behind(tmp_path, fault, raised, message):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail():
        with written_whole(path, SweepError) as beside:
            beside.write_text("half")
            raise fault

    with pytest.raises(raised, match=message):
        fail()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_folder_that_is_missing_is_named(tmp_path):
    with (
        pytest.raises(TableError, match=r"absent/a\.txt: cannot be written"),
        written_whole(tmp_path / "absent" / "a.txt", TableError) as beside,
    ):
        beside.write_text("")


def test_existing_files_are_replaced_only_when_told(tmp_path):
    path = tmp_path / "a.txt"
    refuse_existing(path, False, TableError)
    path.touch()
    refuse_existing(path, True, TableError)
    with pytest.raises(BFSensorError, match=r"a\.txt exists; say overwrite to replace it"):
        refuse_existing(path, False, TableError)


def make_channel(value=1.0):
    return Channel(
        "bias_cov", np.full(1, value), (np.eye(1),), {"lag": np.arange(1)}, "adu2"
    )


def test_a_value_is_made_once_for_each_owner():
    cache, asked = Cache(), []

    def make(channel):
        asked.append(channel)
        return channel.values.sum()

    # Both hold equal values; only their identity differs.
    one, other = make_channel(), make_channel()
    for channel in (one, other, one, other):
        assert cache.get(("sum", channel), lambda c=channel: make(c)) == 1.0
    assert asked == [one, other]


def test_a_key_cannot_be_taken_by_what_is_made_in_its_place():
    cache = Cache()
    # Each is gone at once for all but the cache: without it, its place in memory is reused.
    for n in range(50):
        channel = make_channel(float(n))
        assert cache.get(channel, lambda c=channel: float(c.values[0])) == n


def test_what_was_asked_for_longest_ago_goes_first():
    cache, made = Cache(most=2), []

    def ask(key):
        cache.get(key, lambda: made.append(key))

    for key in "abacab":
        ask(key)
    # c drops b, not a, which was asked for after it; b is made again and drops c.
    assert made == ["a", "b", "c", "b"]


def test_a_failure_is_not_kept():
    cache = Cache()
    with pytest.raises(ZeroDivisionError):
        cache.get("a", lambda: 1 / 0)
    assert cache.get("a", lambda: 2) == 2


def test_pickled_with_its_owners_a_cache_knows_them():
    cache, channel = Cache(), make_channel()
    cache.get(channel, lambda: "kept")
    again, same = pickle.loads(pickle.dumps((cache, channel)))
    assert same is not channel
    assert again.get(same, lambda: "made") == "kept"
    assert again.get(channel, lambda: "made") == "made"


def test_threads_that_write_one_file_leave_one_of_their_texts(tmp_path):
    path = tmp_path / "note.txt"

    def write(n):
        with written_whole(path, TableError) as beside:
            beside.write_text(str(n) * 100_000)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(64)))
    text = path.read_text()
    assert len(set(text)) <= 2 and len(text) in (100_000, 200_000)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


def test_a_link_keeps_leading_to_its_file(tmp_path):
    (tmp_path / "far.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "far.txt")
    with written_whole(tmp_path / "link.txt", TableError) as beside:
        beside.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "far.txt").read_text() == "new"


def test_a_name_that_is_too_long_is_one_clear_error(tmp_path):
    with (
        pytest.raises(TableError, match="cannot be written"),
        written_whole(tmp_path / ("n" * 300), TableError) as beside,
    ):
        beside.write_text("text")


def test_figures_are_written_whole(tmp_path):
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    from bfsensor.plots.style import save_figure

    for end in ("png", "pdf", "svg"):
        save_figure(Figure(), tmp_path / f"a.{end}")
    with pytest.raises(BFSensorError, match="cannot be written"):
        save_figure(Figure(), tmp_path / "absent" / "a.png")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pdf", "a.png", "a.svg"]


def test_levels_of_charges_that_differ_in_the_last_digit_have_two_files():
    names = {_level_name(q, 1e5) for q in (1e5, 100_000.4, np.nextafter(1e5, 2e5))}
    assert len(names) == 3 and "level_100000_100000.npz" in names


def hold(folder, ready, done):
    with held(folder, TableError):
        ready.set()
        done.wait(60)


def test_a_second_process_is_refused_while_the_first_works(tmp_path):
    folder = tmp_path / "t.fits.levels"
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    process = context.Process(target=hold, args=(folder, ready, done))
    process.start()
    assert ready.wait(60)
    number = process.pid
    with (
        pytest.raises(
            TableError, match=rf"t\.fits\.levels: another process .* \(number {number}\)"
        ),
        held(folder, TableError),
    ):
        pass
    process.kill()
    process.join()
    with held(folder, TableError):
        (folder / "level").touch()
    assert [p.name for p in folder.iterdir()] == ["level"]


def test_a_folder_that_stays_empty_is_removed(tmp_path):
    with held(tmp_path / "new" / "one", TableError):
        pass
    (tmp_path / "old").mkdir()
    with held(tmp_path / "old", TableError):
        pass
    assert not (tmp_path / "new" / "one").exists() and (tmp_path / "old").is_dir()
