import os
from dataclasses import dataclass

import pytest

from nl_env.runs import open_folder, replacing, run_sequences, write_text

SETTINGS = {"sequences": 3, "seed": 0}


@dataclass
class Square:
    value: int

    def save(self, path):
        path.write_text(str(self.value))

    @classmethod
    def load(cls, path):
        return cls(int(path.read_text()))


@dataclass
class Squares:
    """A picklable task that can be told to stop at a seed, or to find damaged data."""

    stop_at: int = -1
    broken: int = -1

    def __call__(self, seed):
        if seed == self.stop_at:
            raise KeyboardInterrupt
        if seed == self.broken:
            raise ValueError(f"sequence {seed}: damaged")
        return Square(seed**2)


def test_results_come_in_the_order_of_the_seeds(tmp_path):
    folder = open_folder(tmp_path / "run", SETTINGS)
    found = run_sequences(Squares(), Square.load, [3, 1, 2], folder)
    assert [square.value for square in found] == [9, 1, 4]


def test_worker_processes_give_the_same_results_and_one_thread_each(tmp_path):
    before = os.environ.get("OMP_NUM_THREADS")
    folder = open_folder(tmp_path / "run", SETTINGS)
    found = run_sequences(Threads(), Square.load, [3, 1, 2], folder, workers=2)
    assert [square.value for square in found] == [31, 11, 21]
    assert os.environ.get("OMP_NUM_THREADS") == before


class Threads:
    def __call__(self, seed):
        return Square(10 * seed + int(os.environ["OMP_NUM_THREADS"]))


def test_an_interrupted_run_keeps_what_is_finished_and_goes_on(tmp_path):
    folder = open_folder(tmp_path / "run", SETTINGS)
    with pytest.raises(KeyboardInterrupt):
        run_sequences(Squares(stop_at=2), Square.load, [1, 2, 3], folder)
    assert sorted(path.name for path in folder.iterdir()) == ["1.npz"]

    counted = []
    folder = open_folder(tmp_path / "run", SETTINGS, resume=True)
    found = run_sequences(Squares(stop_at=1), Square.load, [1, 2, 3], folder, progress=counted.append)
    assert [square.value for square in found] == [1, 4, 9]  # 1 would stop if it ran again
    assert counted == [1, 1, 1]


@pytest.mark.parametrize("workers", [0, 1])
def test_damaged_data_stops_a_run_unless_it_is_left_out_and_is_tried_again(tmp_path, workers):
    folder = open_folder(tmp_path / "run", SETTINGS)
    task, seeds, told = Squares(broken=2), [1, 2, 3], []
    with pytest.raises(ValueError, match="sequence 2: damaged"):
        run_sequences(task, Square.load, seeds, folder, workers=workers)
    found = run_sequences(
        task, Square.load, seeds, folder, workers=workers, broken=lambda *what: told.append(what)
    )
    assert [square.value for square in found] == [1, 9]
    assert [(seed, str(error)) for seed, error in told] == [(2, "sequence 2: damaged")]
    mended = run_sequences(Squares(), Square.load, seeds, folder, workers=workers)
    assert [square.value for square in mended] == [1, 4, 9]


def test_a_folder_with_another_run_is_refused(tmp_path):
    folder = open_folder(tmp_path, SETTINGS)
    (folder / "1.npz").write_text("1")
    with pytest.raises(FileExistsError, match="already holds another run"):
        open_folder(tmp_path, SETTINGS)
    with pytest.raises(ValueError, match="other settings: seed is 0, asked 1"):
        open_folder(tmp_path, {**SETTINGS, "seed": 1}, resume=True)
    with pytest.raises(ValueError, match="expected at most one"):
        open_folder(tmp_path, SETTINGS, resume=True, overwrite=True)
    assert (folder / "1.npz").exists()
    assert list(open_folder(tmp_path, {**SETTINGS, "seed": 1}, overwrite=True).iterdir()) == []


def test_a_folder_with_other_files_is_refused_and_never_cleared(tmp_path):
    precious = tmp_path / "thesis.txt"
    precious.write_text("years")
    with pytest.raises(FileExistsError, match="files that are not a run's"):
        open_folder(tmp_path, SETTINGS)
    with pytest.raises(FileExistsError, match="files that are not a run's"):
        open_folder(tmp_path, SETTINGS, resume=True)
    open_folder(tmp_path, SETTINGS, overwrite=True)
    assert precious.read_text() == "years"


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(PermissionError, match="out: cannot write to"):
        open_folder(file / "run", SETTINGS)


def test_replacing_keeps_the_old_file_when_writing_fails(tmp_path):
    path = tmp_path / "results.json"
    write_text(path, "old")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("half a")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


def test_negative_workers_are_refused(tmp_path):
    with pytest.raises(ValueError, match="workers: found -1"):
        run_sequences(Squares(), Square.load, [1], tmp_path, workers=-1)
