"""How the commands in scripts/ end."""

import pytest

from nl_env.command_line import BAD_INPUT, INTERRUPTED, command_line, run_command


def raising(error):
    def work(arguments):
        raise error

    return work


def test_the_command_of_a_result_is_quoted_and_leaves_out_what_concerns_one_run():
    given = ["--out", "my runs", "--resume", "--seed", "0", "--overwrite"]
    assert command_line("record", given) == "python scripts/record.py --out 'my runs' --seed 0"


@pytest.mark.parametrize(("result", "status"), [(None, 0), (0, 0), (1, 1)])
def test_work_gets_the_arguments_and_its_result_is_the_status(result, status):
    seen = []
    assert run_command("record", lambda given: seen.append(given) or result, ("--seed", "0")) == status
    assert seen == [["--seed", "0"]]


@pytest.mark.parametrize(
    "error",
    [ValueError("rate: found -1"), FileNotFoundError("rate: found -1"), ImportError("rate: found -1")],
)
def test_bad_input_is_one_line(error, capsys):
    assert run_command("record", raising(error), [], kept="it is kept", errors=(ImportError,)) == BAD_INPUT
    assert capsys.readouterr().err == "record: rate: found -1\n"


def test_a_failing_disk_says_what_is_kept(capsys):
    assert run_command("record", raising(OSError("disk full")), [], kept="sequences are kept") == BAD_INPUT
    assert capsys.readouterr().err == "record: disk full\nsequences are kept; see --resume\n"


def test_an_interrupt_says_how_to_go_on(capsys):
    work = raising(KeyboardInterrupt())
    assert run_command("record", work, ["--seed", "0", "--overwrite"], kept="it is kept") == INTERRUPTED
    expected = "\ninterrupted; it is kept. Continue with: python scripts/record.py --seed 0 --resume\n"
    assert capsys.readouterr().err == expected
    assert run_command("record", work, []) == INTERRUPTED
    assert capsys.readouterr().err == "\ninterrupted\n"


def test_defects_are_not_hidden():
    with pytest.raises(KeyError):
        run_command("record", raising(KeyError("seed")), [])
